"""Recording sets: `recordings.json`, CSV files, checks of units, importers of other layouts.

Imports `numerics`, `robot`, `effects` and `model`."""
