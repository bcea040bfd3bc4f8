"""Recordings in other layouts, turned into recording sets."""

from rrr_oc.recordings.importers.csv import import_csv
from rrr_oc.recordings.importers.lerobot import import_lerobot
from rrr_oc.recordings.importers.mcap import JointStates, import_mcap
from rrr_oc.recordings.importers.prototype import import_prototype

__all__ = ["JointStates", "import_csv", "import_lerobot", "import_mcap", "import_prototype"]
