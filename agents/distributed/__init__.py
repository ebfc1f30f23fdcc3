"""Work on several processes or machines by Ray, which is not needed for anything else: extra ``ray``."""
