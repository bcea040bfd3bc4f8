"""A simulated robot that shares no physics code with rrr_oc, and cases in which it conceals an effect."""
