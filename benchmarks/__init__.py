"""Comparisons with other libraries: same arrays, same parameters, same threads; see docs/performance.md."""
