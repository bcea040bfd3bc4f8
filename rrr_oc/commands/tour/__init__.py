"""The tour on an arm that comes with the package."""
