"""Floor 8: what people run and other modules do not import: laboratory tests, comparisons of integrators, benchmarks."""
