"""The Monte Carlo behind the studies: points, runs, tables, and the map of tilts."""
