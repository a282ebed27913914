"""Files: written atomically, verified by checksum, never unpickled."""
