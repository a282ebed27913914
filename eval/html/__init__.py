"""Pages to look at in a browser: one file each, no network, nothing to install."""
