"""What each message of the wire may hold: a plan per record and per call, made of rules for its fields."""
