"""Reference pages that are made from the code they describe: files and effects."""
