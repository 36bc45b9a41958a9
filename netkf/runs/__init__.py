"""One run: simulate, summarise, write and read its directory."""
