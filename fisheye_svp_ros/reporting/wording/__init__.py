"""Facts of a diagnosis as sentences: once for terminal, report, diagnosis.json and nodes."""
