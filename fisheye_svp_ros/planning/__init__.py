"""Which photographs to take: planned before the first, asked for one by one, chosen next."""

MAX_VIEWS = 100  # planned at once: more take minutes, and nobody follows such a list
