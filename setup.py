"""The extensions of rrr_oc: Pinocchio's algorithms on casadi.SX, casadi Functions at many instants, steps along sampled signals.

The first two against the headers that the wheels themselves ship. The same sources, compiler and versions make the same wheel, byte
by byte, in whatever folder and at whatever time it is built; `.ci/wheel` checks this.
"""

import os
from pathlib import Path
from typing import Any

import casadi
import cmeel
from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel

site = Path(cmeel.__file__).parent.parent
include = site / "cmeel.prefix" / "include"
casadi_dir = Path(casadi.__file__).parent
# No run path: `import casadi` comes first and brings the library of this SONAME along.
libcasadi = str(next(path for name in ("libcasadi.so.*", "libcasadi.*.dylib") for path in casadi_dir.glob(name)))
# pip builds in a folder of a random name, which headers would otherwise leave in messages of errors.
without_folders = f"-ffile-prefix-map={site}=site-packages"

os.environ.setdefault("SOURCE_DATE_EPOCH", "1577836800")  # of all files in the wheel: the start of 2020, as good as any time


class BdistWheel(bdist_wheel):
    """All files in the wheel have the same rights, whatever those of the builder's files are."""

    def write_wheelfile(self, *arguments: Any) -> None:
        """The last file of the wheel; then it is packed."""
        super().write_wheelfile(*arguments)
        for path in Path(self.bdist_dir).rglob("*"):
            path.chmod(0o755 if path.is_dir() or path.suffix == ".so" else 0o644)


setup(
    cmdclass={"bdist_wheel": BdistWheel},
    ext_modules=[
        Extension(
            "rrr_oc.robot._rigid_body",
            sources=["rrr_oc/robot/_rigid_body.cpp"],
            include_dirs=[str(include), str(include / "eigen3"), str(casadi_dir / "include")],
            define_macros=[
                ("EIGEN_MPL2_ONLY", None),  # an error where a part of Eigen is under the LGPL
                # As the wheel's own CMake configuration exports them.
                ("BOOST_MPL_LIMIT_LIST_SIZE", "30"),
                ("BOOST_MPL_LIMIT_VECTOR_SIZE", "30"),
                ("BOOST_MPL_CFG_NO_PREPROCESSED_HEADERS", None),
                ("BOOST_FUSION_INVOKE_MAX_ARITY", "12"),
            ],
            extra_compile_args=["-std=c++17", "-O1", "-g0", "-w", "-fvisibility=hidden", without_folders],
            extra_link_args=[libcasadi],
        ),
        Extension(
            "rrr_oc.numerics._along",
            sources=["rrr_oc/numerics/_along.cpp"],
            include_dirs=[str(casadi_dir / "include")],
            extra_compile_args=["-std=c++17", "-O3", "-g0", "-w", "-fvisibility=hidden", without_folders],
            extra_link_args=[libcasadi],
        ),
        Extension(
            "rrr_oc.calibration.estimator._evidence",
            sources=["rrr_oc/calibration/estimator/_evidence.cpp"],
            include_dirs=[str(include / "eigen3")],
            define_macros=[("EIGEN_MPL2_ONLY", None), ("NDEBUG", None)],
            extra_compile_args=["-std=c++17", "-O3", "-g0", "-w", "-fvisibility=hidden", "-ffp-contract=off", without_folders],
        ),
        Extension(
            "rrr_oc.numerics._stepping",
            sources=["rrr_oc/numerics/_stepping.cpp"],
            # Without contraction to fused operations results are the same on all machines.
            extra_compile_args=["-std=c++17", "-O3", "-g0", "-fvisibility=hidden", "-ffp-contract=off"],
        ),
    ],
)
