"""The commands that show motions, as files and in a browser."""
