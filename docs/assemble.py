"""What the site has beside the pages of this folder: a page for every effect, and the files of the repository that pages link to.

MkDocs calls these functions (`hooks` in mkdocs.yml). Links in the pages are those of the repository, such as
`../rrr_oc/data/paper.json`; here they come to lead to a copy of the file within the site.
"""

import os
import re
from pathlib import Path, PurePosixPath
from typing import Any

from mkdocs.structure.files import File, Files

from docs.from_code import effects, python_api
from rrr_oc.effects.words import words

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"(\]\()(?!https?:|mailto:|#)([^)#\s]+)((?:#[^)\s]*)?\))")
FENCE = re.compile(r"^```.*?^```$|`[^`\n]+`", re.M | re.S)  # code, in which nothing is a link
BLOCK = re.compile(r"^```.*?^```$", re.M | re.S)
# Symbols in a sentence, as s_j
SUBSCRIPT = re.compile(r"(?<![\w.])([A-Za-zΑ-Ωα-ωℓφ][\u0300-\u036f]?)_([A-Za-z0-9]+(?:,\d)?)(?![A-Za-z0-9_])")
NESTED = re.compile(r"^  - ", re.M)  # a list within a list, which MkDocs wants four spaces in
LANGUAGES = {".py": "python", ".json": "json", ".toml": "toml", ".cff": "yaml", ".urdf": "xml"}
LARGEST = 60_000  # bytes of a file that is shown as a page; a larger one is copied as it is
OVERVIEW = "overview.md"  # README, whose own name would make it the front page
# Folders of the repository with a page that is made from their code
MADE = {"rrr_oc/effects": "effects/index.md", "rrr_oc/python": "reference/python.md"}


def on_config(config: Any) -> Any:
    """Name the effects in the table of contents, by groups."""
    for entry in config.nav:
        for page in entry.get("Effects", ()):
            if page == "effects/index.md":
                entry["Effects"] = [page, *_nav_of_effects()]
    return config


def _nav_of_effects() -> list[dict[str, list[str]]]:
    return [
        {words(group).capitalize(): [f"effects/{kind.name}.md" for kind in kinds]} for group, kinds in effects.groups().items()
    ]


def on_files(files: Files, config: Any) -> Files:
    """Add the pages made from code, README, and every file of the repository that a page links to, those of Markdown with their links."""
    for name, text in effects.pages().items():
        files.append(File.generated(config, f"effects/{name}", content=text))
    files.append(File.generated(config, "reference/python.md", content=python_api.page()))
    files.append(_copy("README.md", config))
    waiting = [file for file in files if file.is_documentation_page()]
    while waiting:
        page = waiting.pop()
        for _, target, _ in LINK.findall(FENCE.sub("", page.content_string)):
            path = _repository(page.src_uri, target)
            there = ROOT / path
            if path.startswith("docs/") or not there.is_file() or files.get_file_from_path(_site(path)):
                continue
            new = _copy(path, config)
            files.append(new)
            if there.suffix == ".md":
                waiting.append(new)
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """The page with links that lead within the site."""

    def within(match: re.Match[str]) -> str:
        there = _site(_repository(page.file.src_uri, match[2]))
        return match[1] + os.path.relpath(there, PurePosixPath(page.file.src_uri).parent) + match[3]

    text = _outside(FENCE, SUBSCRIPT, r"\1<sub>\2</sub>", _outside(FENCE, LINK, within, markdown))
    return _outside(BLOCK, NESTED, "    - ", text)


def _outside(code: re.Pattern[str], pattern: re.Pattern[str], change: Any, text: str) -> str:
    """The text with a pattern replaced, but not in code."""
    parts, at = [], 0
    for found in code.finditer(text):
        parts += [pattern.sub(change, text[at : found.start()]), found[0]]
        at = found.end()
    return "".join([*parts, pattern.sub(change, text[at:])])


def _repository(page: str, target: str) -> str:
    """The path in the repository of a link's target on a page of the site."""
    made = page.startswith("effects/") or page in MADE.values()
    outside = page == OVERVIEW or not ((ROOT / "docs" / page).exists() or made)
    return os.path.normpath(PurePosixPath("" if outside else "docs", PurePosixPath(page).parent, target))


def _site(path: str) -> str:
    """The place in the site of a file of the repository."""
    if path in MADE:
        return MADE[path]
    if path == "README.md":
        return OVERVIEW
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    there = ROOT / path
    shown = there.suffix != ".md" and there.is_file() and there.stat().st_size <= LARGEST
    return f"source/{path}.md" if shown else path


def _copy(path: str, config: Any) -> File:
    there, place = ROOT / path, _site(path)
    if not place.startswith("source/"):
        return File.generated(config, place, abs_src_path=str(there))
    text = there.read_text(encoding="utf-8")
    fence = "`" * 6
    head = "---\nsearch:\n  exclude: true\n---\n\n"
    return File.generated(
        config, place, content=f"{head}# {path}\n\n{fence}{LANGUAGES.get(there.suffix, 'text')}\n{text}\n{fence}\n"
    )
