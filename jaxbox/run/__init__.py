"""The detector as users call it: compiled, batched, streamed, kept between processes, and exported."""
