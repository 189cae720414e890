"""Other programs' chains on the same sweeps, for `benchmarks.bench_peers`."""
