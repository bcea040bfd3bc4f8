"""Springs and motion of a task as one problem.

`task`, `springs` and `design_problem` state it; `search` solves it globally; `catalogue` and
`purchasable` find the best hardware that can be bought; `certificate` says how good an optimum is, `bounds` what
none can be better than; `optimum` samples and simulates it; `transfer` takes it to a calibrated model; `task_sets` has what
several tasks that share the springs need beyond that. `study` goes through all configurations of one task or of several, and
`design_file` is what it finds, as data.

Imports `optimal_control`, `simulation`, `calibration` and what stands below them."""
