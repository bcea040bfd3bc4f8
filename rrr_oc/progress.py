"""How far a computation of several stages is, so that whoever waits for it sees what it does and how long it will take."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Step:
    """How far a computation is.

    Attributes:
        stage: What it does.
        done: Share of the whole that is done, by experience [1].
        said: What has just happened; "" if nothing but that the stage has begun.
        tried: Number of models, starts or the like that were tried in this stage.
        total: How many there will be; 0 where that is not known.
        kind: What was tried, in the plural.
    """

    stage: str
    done: float
    said: str = ""
    tried: int = 0
    total: int = 0
    kind: str = ""


@dataclass(frozen=True)
class Progress:
    """Tells how far a computation is.

    Attributes:
        shares: Of its time that its stages take, in their order, by experience [1].
        report: Who is told.
    """

    shares: Mapping[str, float] = field(default_factory=dict)
    report: Callable[[Step], None] = lambda _: None

    def tell(self, stage: str, within: float = 0.0, said: str = "", tried: int = 0, kind: str = "") -> None:
        """Report that a share `within` [1] of a stage is done."""
        self.report(Step(stage, self._done(stage, within), said, tried, 0, kind))

    def count(self, stage: str, done: int, total: int, said: str = "", kind: str = "") -> None:
        """Report that so many of a stage's equal parts are done."""
        self.report(Step(stage, self._done(stage, done / max(total, 1)), said, done, total, kind))

    def _done(self, stage: str, within: float) -> float:
        names, whole = list(self.shares), sum(self.shares.values())
        before = sum(self.shares[name] for name in names[: names.index(stage)])
        return (before + within * self.shares[stage]) / whole
