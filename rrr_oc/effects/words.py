"""Numbers and sentences about effects as people read them: few digits, the unit, and the 95 % interval."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

NORMAL = 1.96  # standard errors in half of a 95 % interval
DIGITS = 3  # significant ones of a number without an interval; with one, its width decides
MOST_DIGITS = 5  # significant ones at most; recordings of arms do not give more
# Units in which people read a quantity: factor and symbol by the name in a format
READ_AS = {
    "deg": (180 / math.pi, "°"),
    "%": (100.0, "%"),
    "mm": (1e3, "mm"),
    "ms": (1e3, "ms"),
    "mrad": (1e3, "mrad"),
    "rev": (1.0, "times per turn"),
    "per load": (1.0, "Nm per Nm"),
}


@dataclass(frozen=True)
class Number:
    """A value in its unit with the 95 % interval, None where there is none.

    In a format string, `{}` is "0.12 Nm (95 %: 0.10 to 0.14 Nm)". The format may have "abs" for the size without its sign, then one
    of `READ_AS` for another unit; "bare" before either leaves out the interval. "less|more" is the first word where the value is 0 or
    above, else the second.
    """

    value: float
    unit: str = ""
    interval: tuple[float, float] | None = None

    def __str__(self) -> str:
        return self._text(True)

    def __format__(self, spec: str) -> str:
        if "|" in spec:
            return spec.split("|")[self.value < 0]
        parts, shown = spec.split(), self
        for name, (factor, unit) in READ_AS.items():
            if name == spec.removeprefix("bare ").removeprefix("abs "):
                shown = shown._times(factor, unit)
        if "abs" in parts and self.value < 0:
            shown = shown._times(-1.0, shown.unit)
        return shown._text("bare" not in parts)

    def __neg__(self) -> "Number":
        return self._times(-1.0, self.unit)

    def __add__(self, other: float) -> "Number":
        low, high = self.interval or (math.nan, math.nan)
        return Number(self.value + other, self.unit, self.interval and (low + other, high + other))

    def __mul__(self, factor: float) -> "Number":
        """Of the same unit."""
        return self._times(factor, self.unit)

    def _times(self, factor: float, unit: str) -> "Number":
        interval = None if self.interval is None else sorted(factor * x for x in self.interval)
        return Number(factor * self.value, unit, None if interval is None else (interval[0], interval[1]))

    def _text(self, with_interval: bool) -> str:
        unit = "" if self.unit in ("", "1") else self.unit if self.unit == "°" else f" {self.unit}"
        wide = 0.0 if self.interval is None else (self.interval[1] - self.interval[0]) / 2
        one = f"{rounded(self.value, wide)}{unit}"
        if not with_interval or self.interval is None or not wide > 0:
            return one
        low, high = (rounded(x, wide) for x in self.interval)
        return f"{one} (95 %: {low} to {high}{unit})"


@dataclass(frozen=True)
class Several:
    """Numbers of a vector or a matrix in one unit, each with its standard error; "diag" in a format takes a matrix's diagonal."""

    numbers: tuple[Any, ...]
    unit: str = ""

    @property
    def values(self) -> list[float]:
        """The numbers of a vector, without their errors."""
        return [one.value for one in self.numbers]

    def __format__(self, spec: str) -> str:
        chosen = [row.numbers[i] for i, row in enumerate(self.numbers)] if spec == "diag" else self.numbers
        parts = [f"{n:bare}" if isinstance(n, Number) else f"{n}" for n in (_within_error(n) for n in chosen)]
        rows = any(isinstance(n, Several) for n in chosen)  # which have the unit
        return f"({', '.join(parts)}) {self.unit * (not rows)}".rstrip()

    def __str__(self) -> str:
        return format(self, "")


@dataclass(frozen=True)
class ByRecording:
    """Numbers that differ between recordings, by file; a format as of `Number` is that of each."""

    numbers: Mapping[str, Number]

    def __format__(self, spec: str) -> str:
        return listed([f"{number:{spec}} in {file}" for file, number in self.numbers.items()])

    def __str__(self) -> str:
        return format(self, "bare")


def _within_error(one: Any) -> Any:
    """A component as "0.12 ± 0.03", a row of a matrix as itself."""
    if not isinstance(one, Number):
        return one
    if one.interval is None or not one.interval[1] > one.interval[0]:
        return Number(one.value)
    half = (one.interval[1] - one.interval[0]) / 2
    return f"{rounded(one.value, half)} ± {rounded(half, half)}"


def rounded(value: float, uncertainty: float = 0.0) -> str:
    """A number to the digit that its uncertainty (half a 95 % interval) touches."""
    if not math.isfinite(value):
        return "unlimited" if value > 0 else "–"
    size = math.floor(math.log10(abs(value))) if value else 0
    if uncertainty > 0 and math.isfinite(uncertainty):
        decimals = -math.floor(math.log10(uncertainty))
        decimals = min(decimals, MOST_DIGITS - 1 - size) if value else decimals
    else:
        decimals = DIGITS - 1 - size
    if decimals > MOST_DIGITS + 1 or size > MOST_DIGITS:
        return f"{value:.{DIGITS}g}"
    return f"{round(value, decimals) + 0.0:.{max(decimals, 0)}f}"


def read(entry: Mapping[str, Any]) -> Any:
    """A parameter as `diagnosis.json` has it: a `Number`, `Several`, or the value of an option as a text or a tuple of numbers."""
    if entry.get("by_recording"):
        unit = {"unit": entry.get("unit", "")}
        return ByRecording({file: read({**one, **unit}) for file, one in entry["by_recording"].items()})
    value, std, unit = entry["value"], entry.get("std"), entry.get("unit", "")
    if isinstance(value, list) and not any(isinstance(v, str) for v in value) and not unit:
        return tuple(value)
    if isinstance(value, list) and not any(isinstance(v, str) for v in value):
        stds = std if isinstance(std, list) else [None] * len(value)
        return Several(tuple(read({"value": v, "std": s, "unit": unit}) for v, s in zip(value, stds, strict=True)), unit)
    if isinstance(value, list):
        return " and ".join(str(v) for v in value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return words(str(value))
    interval = entry.get("interval")
    if interval is None and isinstance(std, float) and "interval" not in entry:
        interval = value - NORMAL * std, value + NORMAL * std
    known = interval is not None and None not in interval
    return Number(float(value), unit, (float(interval[0]), float(interval[1])) if known and interval is not None else None)


def periodic(values: Mapping[str, Any], phase: Number) -> dict[str, Number]:
    """Where amplitude × cos(order × q − phase) is "most": the joint angle nearest to 0 [rad], and the "period" after which it is again."""
    period = 2 * math.pi / (values["order"].value or math.inf)
    most = (phase + math.pi * (values["amplitude"].value < 0)) * (period / (2 * math.pi))
    turns = round(most.value / period) if math.isfinite(period) and period else 0
    return {"most": most + -turns * period, "period": Number(period, "rad")}


def words(name: str) -> str:
    """A name of files with spaces in place of underscores."""
    return name.replace("_", " ").strip() or name


def joint_words(name: str) -> str:
    """A joint's name as people say it: "wrist 2" for "wrist_2_joint"."""
    said = words(name)
    shorter = said.removesuffix(" joint")
    return shorter or said


def listed(names: Sequence[str]) -> str:
    """ "a", "a and b", "a, b and c"."""
    return " and ".join(([", ".join(names[:-1])] if names[:-1] else []) + list(names[-1:]))


def default_sentence(name: str, joints: Sequence[str], values: Mapping[str, Any]) -> str:
    """What an effect without words of its own was found to be, from its name, joints and parameters."""
    where = f" of {listed(joints)}" if joints else ""
    numbers = listed([f"{words(key)} {value}" for key, value in values.items()])
    return f"The arm has {words(name)}{where}, which the model lacks{': ' * bool(numbers)}{numbers}."
