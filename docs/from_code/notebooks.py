"""The notebooks of the documentation: pages whose code is run, with what it shows behind each block.

    python -m docs.from_code.notebooks FOLDER

runs them in a folder in which `rrr-oc demo` and the `rrr-oc init` of the README ran, and writes what they show into the pages, as Jupyter
would: what is printed, and the table or the picture of a last line that is an expression. Jupytext opens the pages as notebooks.
"""

import argparse
import ast
import io
import os
import re
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

PAGES = sorted((Path(__file__).resolve().parents[1] / "notebooks").glob("*.md"))
IMAGES = Path(__file__).resolve().parents[1] / "images" / "notebooks"
BEGIN, END = "<!-- shown -->", "<!-- end -->"
CELL = re.compile(rf"^```python\n(?P<code>.*?)^```\n(?:\n{BEGIN}\n.*?{END}\n)?", re.M | re.S)


def cells(text: str) -> list[str]:
    """The code of a page, block by block."""
    return [found["code"] for found in CELL.finditer(text)]


def shown(codes: list[str]) -> Iterator[tuple[str, Any]]:
    """What blocks of one page print, and the value of a last line that is an expression; None without one."""
    names: dict[str, Any] = {"__name__": "__main__"}
    for code in codes:
        tree, printed, value = ast.parse(code), io.StringIO(), None
        last = tree.body[-1] if tree.body else None
        whole = last is None or not isinstance(last, ast.Expr)
        with redirect_stdout(printed):
            exec(compile(tree if whole else ast.Module(tree.body[:-1], []), "notebook", "exec"), names)
            if isinstance(last, ast.Expr):
                value = eval(compile(ast.Expression(last.value), "notebook", "eval"), names)
        yield printed.getvalue(), value


def written(page: Path, picture: Callable[[int, bytes], str]) -> str:
    """The text of a page with what its blocks show; `picture` keeps the nth picture and says how it is linked."""
    results = list(shown(cells(page.read_text(encoding="utf-8"))))
    numbers = iter(range(len(results)))

    def block(found: re.Match[str]) -> str:
        k = next(numbers)
        printed, value = results[k]
        parts = [f"```text\n{printed.strip()}\n```"] if printed.strip() else []
        if hasattr(value, "_repr_png_"):
            parts.append(picture(k, value._repr_png_()))
        elif hasattr(value, "_repr_html_"):
            parts.append(value._repr_html_().replace("</p>", "</p>\n").replace("</tr>", "</tr>\n"))
        elif value is not None:
            parts.append(f"```text\n{value!r}\n```")
        behind = "\n".join([BEGIN, *parts, END])
        return f"```python\n{found['code']}```\n" + (f"\n{behind}\n" if parts else "")

    return CELL.sub(block, page.read_text(encoding="utf-8"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", help="name of a page")
    options = parser.parse_args()
    os.chdir(options.folder)
    IMAGES.mkdir(exist_ok=True)
    for page in PAGES:
        if options.only in (None, page.stem):

            def picture(k: int, png: bytes, name: str = page.stem) -> str:
                (IMAGES / f"{name}_{k}.png").write_bytes(png)
                return f"\n![What the block shows](../images/notebooks/{name}_{k}.png)\n"

            page.write_text(written(page, picture), encoding="utf-8")
            print(page.stem, flush=True)


if __name__ == "__main__":
    main()
