"""Variants of the recordings of the paper's own arm, with some of their labels removed."""

from dataclasses import replace

import numpy as np

from rrr_oc.recordings.recording import RecordingSet

VARIANTS = ("labelled", "no_payload", "no_springs", "bare")


def variant(recordings: RecordingSet, name: str) -> RecordingSet:
    """The set with the labels that a variant leaves."""
    every = recordings.recordings
    if name == "no_payload":
        every = tuple(replace(r, payload=np.zeros_like(r.payload)) for r in every)
    if name == "no_springs":
        every = tuple(replace(r, springs=()) for r in every)
    if name == "bare":
        every = tuple(r for r in every if not r.springs and not r.payload.any())
    return replace(recordings, recordings=every)
