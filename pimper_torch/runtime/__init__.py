"""How a run goes: settings, errors, journal, reports, memory, and kept records."""
