"""Studies: compute the signatures of many subjects in a folder that is a BIDS derivative."""
