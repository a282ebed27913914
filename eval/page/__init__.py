"""The results page: its experiments, tables and figures."""
