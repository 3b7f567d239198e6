"""How many broken inputs the slow tests take."""

FRACTION_VARIABLE = "BODYCAP_FUZZ_SHARE"
"""Environment variable with the fraction of the inputs of ``make fuzz`` that the slow tests take."""
DEFAULT_FRACTION = "0.1"
