"""Experiments over many scenes: settings, stores, protocols, runs and tables."""
