"""The node's tasks: options, records on disk, uploads, and the runs that compute them. No HTTP here."""
