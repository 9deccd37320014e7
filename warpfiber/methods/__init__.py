"""One file = one published way to advance a state: which passes, in which order."""
