"""Floor 8: what people run, and nothing below imports: laboratory tests, comparisons of integrators, benchmarks."""
