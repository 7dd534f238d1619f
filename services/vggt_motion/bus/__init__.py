"""Everything Zenoh: nothing outside this package imports zenoh (``sources/zenoh.py`` excepted)."""
