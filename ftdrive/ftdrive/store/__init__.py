"""The store of results and verifications: an index of run folders. The folders stay the truth."""
