"""The extensions of rrr_oc: Pinocchio's algorithms on casadi.SX, casadi Functions at many instants, steps along sampled signals.

The first two against the headers that the wheels themselves ship.
"""

from pathlib import Path

import casadi
import cmeel
from setuptools import Extension, setup

site = Path(cmeel.__file__).parent.parent
include = site / "cmeel.prefix" / "include"
casadi_dir = Path(casadi.__file__).parent
# No run path: `import casadi` comes first and brings the library of this SONAME along.
libcasadi = str(next(casadi_dir.glob("libcasadi.so.*")))

setup(
    ext_modules=[
        Extension(
            "rrr_oc.robot._rigid_body",
            sources=["rrr_oc/robot/_rigid_body.cpp"],
            include_dirs=[str(include), str(include / "eigen3"), str(casadi_dir / "include")],
            # As the wheel's own CMake configuration exports them.
            define_macros=[
                ("BOOST_MPL_LIMIT_LIST_SIZE", "30"),
                ("BOOST_MPL_LIMIT_VECTOR_SIZE", "30"),
                ("BOOST_MPL_CFG_NO_PREPROCESSED_HEADERS", None),
                ("BOOST_FUSION_INVOKE_MAX_ARITY", "12"),
            ],
            extra_compile_args=["-std=c++17", "-O1", "-g0", "-w", "-fvisibility=hidden"],
            extra_link_args=[libcasadi],
        ),
        Extension(
            "rrr_oc.numerics._along",
            sources=["rrr_oc/numerics/_along.cpp"],
            include_dirs=[str(casadi_dir / "include")],
            extra_compile_args=["-std=c++17", "-O3", "-g0", "-w", "-fvisibility=hidden"],
            extra_link_args=[libcasadi],
        ),
        Extension(
            "rrr_oc.numerics._stepping",
            sources=["rrr_oc/numerics/_stepping.cpp"],
            # Without contraction to fused operations results are the same on all machines.
            extra_compile_args=["-std=c++17", "-O3", "-g0", "-fvisibility=hidden", "-ffp-contract=off"],
        ),
    ],
)
