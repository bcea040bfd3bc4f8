"""The search for the best springs and motion: proposals, local optima, the best motions for given springs, and the multistart that
joins them."""
