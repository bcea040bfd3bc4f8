"""What is said of what a search found: how large it is, on what it depends, what cannot be told from it, how often that is right."""
