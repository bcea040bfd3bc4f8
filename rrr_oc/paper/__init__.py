"""The paper's own method beside the gradient.

`encoding` (the parametrisation), `engine_population` and `evolution` (CMA-ES in MuJoCo or the model), `parametrised` and `fixed_motion`
(IPOPT on the same variables, and on springs alone), `experiments` and `run_store` (the runs), `comparison` and `statistics` (their
summary), `published` (the paper's tables).

Imports `codesign` and what stands below it."""
