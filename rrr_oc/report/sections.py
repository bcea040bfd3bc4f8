"""A report as a list of sections, from which both its Markdown and its page are made."""

from collections.abc import Sequence
from dataclasses import dataclass

from rrr_oc.report.tables import Table, markdown


@dataclass(frozen=True)
class Passage:
    """What stands together in a section, in this order.

    Attributes:
        heading: Above it, if not empty.
        said: Paragraphs.
        points: Items of a list.
        table: A table, if there is one.
        note: Small print.
        of: The configuration that it belongs to, which a page shows when it is chosen; "" for all.
        figures: Names of the page's figures.
    """

    heading: str = ""
    said: tuple[str, ...] = ()
    points: tuple[str, ...] = ()
    table: Table | None = None
    note: str = ""
    of: str = ""
    figures: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """As Markdown; figures are the page's alone."""
        parts = [f"### {self.heading}\n"] * bool(self.heading) + [f"{one}\n" for one in self.said]
        parts += ["\n".join(f"- {one}" for one in self.points) + "\n"] * bool(self.points)
        parts += [] if self.table is None else [markdown(*self.table)]
        return "\n".join([*parts, *[f"{self.note}\n"] * bool(self.note)])


@dataclass(frozen=True)
class Section:
    """A section of a report.

    Attributes:
        title: Its title.
        parts: What stands in it.
    """

    title: str
    parts: tuple[Passage, ...]


def as_markdown(sections: Sequence[Section]) -> str:
    """Sections as Markdown, without those that have figures alone."""
    texts = [(section.title, [part.text for part in section.parts if part.text.strip()]) for section in sections]
    return "\n".join("\n".join([f"## {title}\n", *parts]) for title, parts in texts if parts)
