import sys,json
from pathlib import Path
from splatpipe.pipeline.app.sentences import sentence
for run in sys.argv[1:]:
    for d in sorted(Path(run,"stages").iterdir()):
        f=d/"manifest.json"
        if f.exists(): n=d.name.rsplit("-",1)[0]; print(f"{n:12s}",sentence(n,json.loads(f.read_text())["summary"]))
