"""The search over structures: linear problems about fits, candidates, neighbours, and the moves from one to the next."""
