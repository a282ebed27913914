"""The pages of results: their experiments, tables and figures."""
