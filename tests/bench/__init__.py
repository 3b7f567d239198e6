"""Benchmarks: slow measurements against ground truth, printed by ``make bench``."""
