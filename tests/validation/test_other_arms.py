"""Tasks of others' arms from their robot files, and what the table says of fewer springs and held postures."""

import pytest
from chains import arm

from rrr_oc.codesign.springs import offered
from rrr_oc.codesign.task import load_task
from rrr_oc.errors import UserError
from validation.other_arms import CASES, checks, written


def test_a_task_begins_as_init_writes_it_and_has_a_spring_across_its_joints(tmp_path):
    text = arm(2).replace('"j1"', '"shoulder_lift"').replace('"j2"', '"elbow_flex"')
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "so101.urdf").write_text(text)
    file = written(tmp_path / "robots", tmp_path / "tasks", "desktop arm")
    task = load_task(str(file))
    assert task.joints == CASES["desktop arm"].moving
    assert {"SA", "PEA", "BPEA", "PEA+BPEA"} <= set(offered(task))
    before = file.read_bytes()
    assert written(tmp_path / "robots", tmp_path / "tasks", "desktop arm") == file
    assert file.read_bytes() == before
    with pytest.raises(UserError, match=r"no panda\.urdf below it"):
        written(tmp_path / "robots", tmp_path / "tasks", "Panda, free postures")


def test_more_springs_and_free_postures_that_are_worse_are_named():
    best = {("a", "SA"): 10.0, ("a", "PEA"): 4.0, ("a", "PEA+BPEA"): 4.1}
    best |= {("b, held postures", "PEA"): 5.0, ("b, free postures", "PEA"): 4.0}
    assert checks(best) == [
        "4 pairs of fewer and more springs, or held and free postures: 1 where more is worse.",
        "a with PEA+BPEA: 4.1, a with PEA: 4.",
        "b with PEA: free postures save 20.0 %.",
    ]
