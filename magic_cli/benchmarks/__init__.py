"""Command lines of the benchmarks; what they measure lives with what is measured."""
