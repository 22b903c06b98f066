"""The hostile inputs of `abuse.py`: sound files, ways to damage them, and the cases made of both."""
