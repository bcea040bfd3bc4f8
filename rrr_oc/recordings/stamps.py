"""Time stamps of samples that a driver hands over several at once."""

import numpy as np

TOGETHER = 0.1  # of the mean step, below which two samples were handed over at once; doubled, jitter counts as that
BATCHED = 0.3  # share of such steps from which samples came in batches; doubled, batches of two are no batches
LEAST = 8  # samples, and batches, from which these are told
PAUSE = 1.6  # times the usual time of a sample, above which samples are missing before a batch; doubled, gaps are filled


def spread(t: np.ndarray) -> tuple[np.ndarray, float]:
    """Stamps t (K,) [s], not decreasing, as the samples were taken, and how many samples a batch has; 1 where they came one by one.

    A batch is stamped when it is handed over, with its last sample. Where samples at even distances fit all stamps within a sample or
    two, they have these. Else some are missing, and those of a batch are spread evenly over the time since the batch before; after a pause they
    have the usual distance.
    """
    with np.errstate(all="ignore"):  # absurd times are refused elsewhere
        steps = np.diff(t)
        mean = float(np.mean(steps)) if len(t) >= LEAST else np.nan
    if not (np.isfinite(mean) and np.all(steps >= 0)):
        return t, 1.0
    together = steps < TOGETHER * mean
    if np.mean(together) < BATCHED:
        return t, 1.0
    ends = np.append(np.flatnonzero(~together), len(t) - 1)  # the last sample of each batch
    if len(ends) < LEAST:
        return t, 1.0
    counts, arrivals = np.diff(ends, prepend=-1), t[ends]
    each, size = np.diff(arrivals) / counts[1:], float(np.median(counts))
    usual, whole = float(np.median(each)), slice(1, -1)  # the first and the last batch may not be whole
    line = np.polynomial.Polynomial.fit(ends[whole], arrivals[whole], 1)
    if np.max(np.abs(arrivals - line(ends))[whole]) < PAUSE * usual:
        return line(np.arange(len(t))), size
    each = np.append(usual, np.where(each > PAUSE * usual, usual, each))
    to_end = np.repeat(ends, counts) - np.arange(len(t))
    return np.repeat(arrivals, counts) - to_end * np.repeat(each, counts), size
