"""The paper's own method, for the studies that compare it.

`encoding` (the parametrisation, with the splines of `akima`), `engine_population` and `evolution` (CMA-ES in MuJoCo or the model),
`parametrised` and `fixed_motion` (IPOPT on the same variables, and on springs alone), `experiments` and `run_store` (the runs),
`comparison` and `statistics` (their summary), `comparison_report` and `comparison_figures` (what is shown of it), `driven` (optima on
the arm with its drives), `sweeps` (the motions by which that is calibrated)."""
