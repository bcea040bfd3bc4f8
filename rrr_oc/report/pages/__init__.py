"""Reports as HTML pages that one can send: complete in one file, without a request to any network.

`page` has what all pages share; a design's and a diagnosis' page each have a module for their content and one for what it is made
from: `design_words`, the sentences, and `diagnosis_curves`, the saved data of the figures."""
