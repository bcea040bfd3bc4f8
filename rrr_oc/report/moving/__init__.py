"""Motions shown: what is in the picture, its shapes in space, moving pictures in files, and a viewer in the browser."""
