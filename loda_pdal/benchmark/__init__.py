"""Simulated scenes with known truth, protocols and scores."""
