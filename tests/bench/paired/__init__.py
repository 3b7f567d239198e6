"""Compare two versions of the program on captures and on perturbations of them."""
