"""Results to compare, as they lie in folders and files."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rrr_oc.calibration import model_file
from rrr_oc.codesign import design_file
from rrr_oc.codesign.design_file import DesignFile
from rrr_oc.comparison.designs import Pair, compare_designs
from rrr_oc.comparison.fleet import Fleet, fleet
from rrr_oc.comparison.models import Compared, Side, compare_models
from rrr_oc.comparison.words import design_verdict, fleet_table, fleet_verdict, verdict
from rrr_oc.diagnosis import diagnosis_file
from rrr_oc.diagnosis.diagnosis_file import DiagnosisFile
from rrr_oc.errors import UserError
from rrr_oc.schema import built, parsed, read_json, with_nan
from rrr_oc.storage import plain, read_utf8

FORMAT = "rrr_oc-comparison/1"
FILES = ("diagnosis.json", "summary.json", "model.json")  # of what a folder holds the first counts
Designs = tuple[DesignFile, dict[str, Pair]]


def compared(a: Path, b: Path) -> Compared | Designs:
    """Two diagnoses or models, or two designs, each a folder or a JSON file; of designs the first, and each configuration in both.

    Raises `UserError` for anything else, and for two that cannot be compared.
    """
    one, other = _read(a), _read(b)
    if isinstance(one, DesignFile) and isinstance(other, DesignFile):
        return one, compare_designs(one, other)
    if isinstance(one, Side) and isinstance(other, Side):
        return compare_models(one, other)
    kinds = [f"{path} is a {'design' if isinstance(x, DesignFile) else 'model'}" for path, x in ((a, one), (b, other))]
    raise UserError(f"{', but '.join(kinds)}; two of a kind can be compared")


def compared_fleet(paths: Sequence[Path]) -> Fleet:
    """Diagnoses of arms of one make, each a folder or its diagnosis.json; raises `UserError` for anything else."""
    sides = [_read(path) for path in paths]
    told = [one for one in sides if isinstance(one, Side) and one.told is not None]
    if len(told) < len(sides):
        other = next(path for path, one in zip(paths, sides, strict=True) if one not in told)
        raise UserError(f"{other}: is no diagnosis; a comparison of more than two, and a page, is one of diagnoses")
    return fleet(told, [built(with_nan(one.told, DiagnosisFile), DiagnosisFile) for one in told])


def fleet_data(found: Fleet) -> dict[str, Any]:
    """A fleet as plain data; the diagnoses have their own files."""
    header, rows = fleet_table(found)
    arms = [dict(zip(header, row, strict=True)) for row in rows]
    outliers = [{"arm": one.arm, "median": one.median, "times": one.times, **asdict(one.of)} for one in found.outliers]
    return plain({"format": FORMAT, "kind": "fleet", "said": fleet_verdict(found), "arms": arms, "outliers": outliers})


def as_data(a: Path, b: Path, found: Compared | Designs) -> dict[str, Any]:
    """A comparison as plain data, in SI units."""
    head = {"format": FORMAT, "a": str(a), "b": str(b)}
    if isinstance(found, Compared):
        return plain({**head, "kind": "models", "said": verdict(found), **asdict(found)})
    design, pairs = found
    head["said"] = design_verdict(*found)
    unit = {"cost": design.quantity.name, "unit": design.quantity.unit}
    return plain({**head, "kind": "designs", **unit, "configurations": {name: asdict(pair) for name, pair in pairs.items()}})


def _read(path: Path) -> Side | DesignFile:
    """What a path leads to."""
    file = path
    if path.is_dir():
        there = [path / name for name in FILES if (path / name).is_file()]
        if not there:
            raise UserError(f"{path}: nothing to compare; allowed is a folder with one of {', '.join(FILES)}")
        file = there[0]
    content = parsed(file, read_utf8(file).decode())
    kind = content.get("format") if isinstance(content, dict) else None
    if kind == design_file.FORMAT:
        return read_json(file, DesignFile)
    if kind == diagnosis_file.FORMAT:
        return Side(str(path), model_file.load_model(file.parent / "model.json"), content)
    if kind == model_file.FORMAT:
        return Side(str(path), model_file.load_model(file))
    allowed = ", ".join((diagnosis_file.FORMAT, model_file.FORMAT, design_file.FORMAT))
    raise UserError(f"{file}: its format is {kind!r}; {allowed} can be compared")
