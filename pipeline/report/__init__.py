"""The report of a run: one page for the client, built from the events and the manifests."""
