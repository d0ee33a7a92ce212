import time,sys; from pathlib import Path
t=time.time()
from splatpipe.pipeline.app.ending import _verdict
from splatpipe.pipeline.app.console import show_verdict
v=_verdict(Path(sys.argv[1])); show_verdict(v); print(time.time()-t)
