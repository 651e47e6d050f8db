"""Accuracy against time: what each engine and viewport costs, and what it misses."""
