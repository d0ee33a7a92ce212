"""The chapters of a report: each is what its template shows, made from the report's inputs."""
