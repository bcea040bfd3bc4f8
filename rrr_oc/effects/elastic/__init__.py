"""Springs and cables on the links, and what is wrong with springs that a recording lists."""
