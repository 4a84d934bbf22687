"""Infrastructure of runs: settings, errors, events, reports, memory, and kept records."""
