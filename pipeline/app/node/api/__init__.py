"""The node's HTTP interface: NodeODM's calls, what a request may be, and who may send it."""
