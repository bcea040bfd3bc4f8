"""The functions of `import rrr_oc`, and the results that they return.

Each function but `load` runs the command of its name in this process, with the same options, files and progress; what the command would
print is the result. Imports everything else."""

from rrr_oc.python.functions import calibrate, compare, design, diagnose, export, load, simulate

__all__ = ["calibrate", "compare", "design", "diagnose", "export", "load", "simulate"]
