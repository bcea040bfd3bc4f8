"""Discovery of missing physics: one posterior over models. See docs/discovery.md."""
