"""Policies compared in the same scenes: what the studies of search and exploration share."""
