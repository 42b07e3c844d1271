"""Benchmarks: run by hand, print tables; nothing here asserts a time."""
