"""The Monte Carlo behind the studies: points, runs, tables, map."""
