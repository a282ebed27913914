"""Short programs that use semfov as a library."""
