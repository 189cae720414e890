"""What exists because of a compiler: loops, look-ups, compaction and packed bits at a fixed shape."""
