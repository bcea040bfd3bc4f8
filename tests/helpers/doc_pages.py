"""README and docs, and the code in them."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "validation/concealed/README.md")),
    *sorted((ROOT / "docs").glob("*.md")),
]
CURRENT = [page for page in PAGES if page.name != "CHANGELOG.md"]  # a changelog also names what is gone


def blocks(text: str) -> list[tuple[str, str]]:
    """Language and content of every fenced block."""
    return re.findall(r"^```(\w*)\n(.*?)^```$", text, re.M | re.S)


def code(text: str) -> list[str]:
    """Everything set as code: spans in backticks, and lines of blocks without a language or of a shell."""
    lines = [line for language, content in blocks(text) if language in ("", "sh", "bash") for line in content.splitlines()]
    without = re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S)
    return lines + [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", without)]
