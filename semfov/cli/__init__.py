"""The command `semfov`: search, find, explore, live, fit and detectors, without a checkout."""
