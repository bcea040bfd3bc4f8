"""The model in MuJoCo: effects as generated C, joint controllers, tracking of motions.

Imports `numerics`, `robot`, `effects` and `model`."""
