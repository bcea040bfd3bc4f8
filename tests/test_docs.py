"""README and docs against the repository: their Python imports, and the files, commands and options that they name exist."""

import ast
import importlib
import os
import re
import subprocess
import sys
from collections.abc import Callable
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import unquote

import pytest
import typer
from doc_pages import CURRENT, PAGES, ROOT, blocks, code

from docs.from_code.pictures import IMAGES, MADE
from rrr_oc.commands import COMMANDS, app, load
from rrr_oc.effects import CATALOGUE
from rrr_oc.errors import STATUSES


def missing_names(text: str) -> list[str]:
    """Modules and names that Python code imports and that do not exist."""
    missing = []
    for node in ast.walk(ast.parse(text)):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
        if isinstance(node, ast.ImportFrom):
            missing += [f"{node.module}.{name}" for name in names if not exists(f"{node.module}.{name}")]
        else:
            missing += [name for name in names if not exists(name)]
    return missing


def exists(dotted: str) -> bool:
    """Whether a dotted name is a module, or an attribute of one."""
    parts = dotted.split(".")
    for k in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:k]))
        except ModuleNotFoundError:
            continue
        for part in parts[k:]:
            if not hasattr(found, part):
                return False
            found = getattr(found, part)
        return True
    return False


def missing_paths(text: str) -> list[str]:
    """Paths below the repository's folders, in code, that do not exist."""
    folders = "|".join(
        re.escape(p.name) for p in ROOT.iterdir() if p.is_dir() and p.name not in (".git", ".venv", "build", "results")
    )
    named = {path for span in code(text) for path in re.findall(rf"(?<![\w./-])(?:{folders})/[\w./-]*\w/?", span)}
    return [path for path in sorted(named) if not (ROOT / path).exists()]


def missing_links(page: Path, text: str) -> list[str]:
    """Targets of relative links that do not exist."""
    targets = re.findall(r"\]\((?!https?:)([^)#]+)(?:#[^)]*)?\)", text)
    return [target for target in targets if not (page.parent / target).exists()]


def unknown_options(command: str) -> list[str]:
    """Targets of make, subcommands of `rrr-oc` and options that do not exist, of one command line."""
    words = [re.sub(r"[\[\]\"',;:]", "", word) for word in command.split()]
    options = [word.split("=")[0] for word in words if word.startswith("--") and word != "--help"]
    if words[:1] == ["make"]:
        targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M))
        return [w for w in words[1:2] if w not in targets]
    if words[:1] == ["rrr-oc"]:
        found = typer.main.get_command(app)
        if words[1:] and words[1] in COMMANDS:
            found = load(words[1])
        for word in words[2:]:
            if word not in getattr(found, "commands", {}):
                break
            found = found.commands[word]
        known = {name for parameter in found.params for name in (*parameter.opts, *parameter.secondary_opts)}
        named = not hasattr(found, "commands") or not words[1:] or words[1].startswith("-")
        unknown = [] if named or (len(words) == 2 and words[1] in COMMANDS) else [" ".join(words[:3])]
        return unknown + [option for option in options if option not in known]
    scripts = [word for word in words if re.fullmatch(r"(studies|validation)/[\w/]+\.py", word)]
    known = (ROOT / scripts[0]).read_text() if scripts else ""
    if "rrr_oc.commands.design" in known:  # the script takes the command's options
        known += "".join(f'"{name}"' for parameter in load("design").params for name in parameter.opts)
    return [option for option in options if scripts and not declared(option, known)]


def declared(option: str, script: str) -> bool:
    """Whether a script declares an option, to argparse by its name or to typer as a parameter of its command."""
    return (
        f'"{option}"' in script
        or re.search(rf"^    {option[2:].replace('-', '_')}: (?:Annotated|[A-Z])", script, re.M) is not None
    )


def on_pages(check: Callable[[str], list[str]]) -> dict[str, list[str]]:
    """What a check finds wrong on each page that is not right."""
    found = {str(page.relative_to(ROOT)): check(page.read_text()) for page in CURRENT}
    return {page: wrong for page, wrong in found.items() if wrong}


def test_python_imports_what_exists():
    def check(text: str) -> list[str]:
        return [name for language, content in blocks(text) if language == "python" for name in missing_names(content)]

    assert on_pages(check) == {}


def test_dotted_names_exist():
    def check(text: str) -> list[str]:
        named = {name for span in code(text) for name in re.findall(r"(?<![\w./-])rrr_oc(?:\.\w+)+", span)}
        return [name for name in sorted(named) if not exists(name)]

    assert on_pages(check) == {}


def test_paths_exist():
    assert on_pages(missing_paths) == {}


def test_the_tour_names_modules_that_exist():
    """Modules in docs/architecture.md are named from `rrr_oc/` on."""
    named = set(re.findall(r"`([\w/]+\.py)`", (ROOT / "docs" / "architecture.md").read_text()))
    assert len(named) > 20
    assert not [path for path in sorted(named) if not (ROOT / "rrr_oc" / path).exists() and not (ROOT / path).exists()]


def test_links_lead_somewhere():
    found = {str(page.relative_to(ROOT)): missing_links(page, page.read_text()) for page in PAGES}
    assert {page: targets for page, targets in found.items() if targets} == {}


def test_commands_and_options_exist():
    assert on_pages(lambda text: [f"{line}: {bad}" for line in code(text) for bad in unknown_options(line)]) == {}


def test_the_readme_names_every_page():
    text = (ROOT / "README.md").read_text()
    assert not [page.name for page in (ROOT / "docs").glob("*.md") if f"docs/{page.name}" not in text]


def test_the_start_has_every_command_and_exit_status():
    text = (ROOT / "docs" / "start.md").read_text()
    assert set(re.findall(r"^\| `rrr-oc (\w+)` \|", text, re.M)) == set(COMMANDS)
    assert "; ".join(f"{status}: {meaning}" for status, meaning in STATUSES.items()) in " ".join(text.split())


def test_the_readme_is_read_in_minutes():
    """With one picture, which is small."""
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 110
    (picture,) = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)
    assert (ROOT / picture).stat().st_size < 150_000


def test_the_checks_find_what_is_missing(tmp_path):
    """The tests' own tools, on names that do not exist."""
    assert missing_names("from rrr_oc.errors import UserError, Nothing\nimport rrr_oc.nowhere\n") == [
        "rrr_oc.errors.Nothing",
        "rrr_oc.nowhere",
    ]
    assert missing_paths("`studies/none.py` and `tests/test_docs.py`\n```\npython validation/none.py\n```\n") == [
        "studies/none.py",
        "validation/none.py",
    ]
    assert missing_links(tmp_path / "a.md", "[a](b.md), [c](https://c.org)") == ["b.md"]
    assert unknown_options("make study") == []
    assert unknown_options("make coffee") == ["coffee"]
    assert unknown_options("rrr-oc diagnose x --out y --jobs 1") == []
    assert unknown_options("rrr-oc diagnose --magic") == ["--magic"]
    assert unknown_options("rrr-oc fly") == ["rrr-oc fly"]
    assert unknown_options("python studies/pea_bpea.py --starts 6") == []
    assert unknown_options("python studies/pea_bpea.py --magic 6") == ["--magic"]


class Links(HTMLParser):
    """Links of a page, and what the page itself loads."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.places: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.places |= {given[name] for name in ("id", "name") if name in given}
        if tag == "a":
            self.links.append(given.get("href", ""))
        elif tag in ("script", "img", "source") or (tag == "link" and given.get("rel") != "canonical"):
            self.loaded.append(given.get("src", given.get("href", "")))


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> dict[Path, Links]:
    """The pages of the site, built as `make docs` builds it."""
    if find_spec("mkdocs") is None or find_spec("material") is None:
        pytest.skip("mkdocs-material is not installed; the extra 'docs' has it")
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(out)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1", "MPLBACKEND": "Agg"}
    built = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    pages = {}
    for path in out.rglob("*.html"):
        pages[path] = Links()
        pages[path].feed(path.read_text(encoding="utf-8"))
    return pages


def test_links_of_the_site_lead_to_pages_files_and_headings(site):
    broken = []
    for page, found in site.items():
        for link in found.links if page.name != "404.html" else ():
            target, _, place = unquote(link).partition("#")
            there = (page.parent / target).resolve() if target else page
            if not target.startswith(("http:", "https:")):
                known = there.is_file() and (not place or there not in site or place in site[there].places)
                broken += [] if known or place.startswith("__") else [f"{page.name}: {link}"]
    assert not broken


def test_the_site_loads_nothing_from_elsewhere(site):
    assert not {one for found in site.values() for one in found.loaded if one.startswith(("http:", "https:", "//"))}


def test_a_browser_sets_every_equation_within_the_screen(site, browser):
    said, equations = [], 0
    for width in (1280, 390):
        page = browser.new_page(viewport={"width": width, "height": 900})
        page.on("pageerror", lambda error: said.append(str(error)))
        for path in (p for p in site if "arithmatex" in p.read_text()):
            page.goto(path.as_uri())
            equations += page.locator(".arithmatex .katex-display").count()
            assert page.locator(".arithmatex").count() == page.locator(".arithmatex .katex-display").count()
            assert page.evaluate("document.documentElement.scrollWidth") <= width, path.name
    assert said == []
    assert equations > 20


def test_files_outside_the_pages_are_shown_in_the_site(site):
    texts = {"/".join(p.parts[p.parts.index("source") :]): p.read_text() for p in site if "source" in p.parts}
    assert "payload_kg" in texts["source/rrr_oc/data/paper.json.html"]
    assert "class Stribeck" in re.sub("<[^>]*>", "", texts["source/rrr_oc/effects/friction/stribeck.py.html"])


def test_the_table_of_contents_has_every_page_of_the_folder_and_every_effect(site):
    index = min((p for p in site if p.name == "index.html"), key=lambda p: len(p.parts))
    listed = {str((index.parent / link.partition("#")[0]).resolve()) for link in site[index].links}
    wanted = [p.relative_to(ROOT / "docs").with_suffix(".html") for p in (ROOT / "docs").rglob("*.md")]
    wanted += [Path("effects") / f"{name}.html" for name in ("index", *CATALOGUE)]
    assert not [str(path) for path in wanted if str(index.parent.resolve() / path) not in listed]


def test_the_gallery_has_every_study():
    text = (ROOT / "docs" / "gallery.md").read_text()
    assert not [path.name for path in (ROOT / "studies").glob("*.py") if f"studies/{path.name}" not in text]


ELSEWHERE = {  # pictures that other commands make, or a hand
    "conventions.svg": "drawn by hand",
    "natural_dynamics.png": "studies/natural_dynamics.py",
    "twelve_tasks.png": "rrr-oc design twelve_tasks",
}
WITHOUT = {"architecture", "discovery", "glossary", "licences", "supply_chain", "worked_example"}  # pages of text and tables


def test_pages_have_pictures_and_a_command_makes_each():
    linked = {p.stem: re.findall(r"\]\(images/([\w./]+)\)", p.read_text()) for p in (ROOT / "docs").glob("*.md")}
    assert {page for page, pictures in linked.items() if not pictures} == WITHOUT
    there = {p.name for p in IMAGES.iterdir() if p.is_file()}
    assert there == {*MADE, *ELSEWHERE}
    assert there >= {name for names in linked.values() for name in names if "/" not in name}
