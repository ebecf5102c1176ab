"""Floor 8: what people run and nobody imports: laboratory scenes, comparisons of integrators, benchmarks."""
