"""Which photographs to take: planned before the first, asked for one by one, chosen next."""
