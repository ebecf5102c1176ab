"""Floor 8: laboratory tests, comparisons of integrators, and benchmarks.  Lower floors do not import it."""
