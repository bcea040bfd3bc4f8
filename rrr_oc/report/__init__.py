"""Tables, figures and pages made from results. Only this folder and the command line print or plot.

Imports everything else."""
