"""Optimal-control problems, direct collocation, IPOPT, mesh refinement, optimality conditions.

Knows no robot; imports nothing but the modules at the root."""
