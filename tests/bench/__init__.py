"""Benchmarks: slow figures against ground truth, printed by ``make bench``."""
