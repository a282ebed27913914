"""Figures of merit: of searches, of explorations, of probabilities."""
