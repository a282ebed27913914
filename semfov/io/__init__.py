"""Files: whole or not there, checksummed, never unpickled."""
