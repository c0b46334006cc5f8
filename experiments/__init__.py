"""What the papers measured, measured again, and studies of the methods: `python -m experiments`."""
