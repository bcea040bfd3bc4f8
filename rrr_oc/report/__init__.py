"""Tables, figures and pages made from results. Only this folder and `commands` print or plot.

A design's and a diagnosis' report and figures each have a module; `design_words` has a design's sentences,
`sections` the parts of a report from which its Markdown and its page are made, `tables` what they share, `study_files` what a
study writes, `figures` how figures are saved, `console` where commands print.

Imports everything else but `commands`."""
