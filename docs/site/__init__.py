"""The site: how it is put together and built."""
