import sys,json
from pathlib import Path
for run in sys.argv[1:]:
    for d in sorted(Path(run,"stages").iterdir()):
        f=d/"manifest.json"
        if not f.exists():
            fs=[x for x in d.glob("*.json")]; print(d.name,[x.name for x in fs][:6]); continue
        s=json.loads(f.read_text()).get("summary",{})
        print(Path(run).name,d.name.rsplit("-",1)[0],json.dumps({k:(v if not isinstance(v,(dict,list)) else type(v).__name__) for k,v in s.items()})[:1500])
