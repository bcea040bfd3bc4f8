"""What each command of `rrr-oc` does. Modules are imported when their command runs, so that `--help` needs none of them."""
