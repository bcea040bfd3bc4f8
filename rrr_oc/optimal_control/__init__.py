"""Optimal control: `problem` (what to minimise), `scheme` (collocation methods and meshes), `transcription` (the nonlinear program, from
the functions of one `interval` and sums by `scatter`), `solver` (IPOPT), `refinement` (mesh error and finer meshes), `optimality`
(first- and second-order conditions).

It has no notion of a robot and imports only the modules at the root."""
