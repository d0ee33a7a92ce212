"""Photos on meshes: which photo each triangle shows, charts, pages and the files of textured meshes."""
