"""`python -m rrr_oc` is `rrr-oc`."""

from rrr_oc.cli import main

main()
