"""Numerical tools that know no robot: smooth functions, filters, oscillators, CasADi functions at many instants.

Imports nothing but the modules at the root."""
