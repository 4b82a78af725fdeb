"""Slow and obvious twins of the fast code, for tests only: written from the definition, never from the kernel."""
