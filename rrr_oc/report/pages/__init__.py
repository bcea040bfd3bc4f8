"""Reports as HTML pages that one can send: complete in one file, without a request to any network.

`page` has what all pages share; a design's and a diagnosis' page each have a module for their content. `diagnosis_curves` saves the data
of a diagnosis' figures."""
