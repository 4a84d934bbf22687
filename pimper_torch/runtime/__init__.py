"""Infrastructure of runs: settings, errors, journal, reports, memory, and kept records."""
