"""Recordings in other layouts, turned into recording sets."""

from rrr_oc.recordings.importers.arrays import import_arrays
from rrr_oc.recordings.importers.csv import import_csv
from rrr_oc.recordings.importers.lerobot import import_lerobot
from rrr_oc.recordings.importers.prototype import import_prototype
from rrr_oc.recordings.importers.ros import JointStates, import_ros

__all__ = ["JointStates", "import_arrays", "import_csv", "import_lerobot", "import_prototype", "import_ros"]
