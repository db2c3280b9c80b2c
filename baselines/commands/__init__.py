"""Commands of ``tlf`` that are more than a call: each from its options to what it prints."""
