#!/bin/bash
#SBATCH --job-name=splatpipe
#SBATCH --cpus-per-task=8
#SBATCH --mem=16G
#SBATCH --time=08:00:00
#SBATCH --signal=B:USR1@60
#SBATCH --requeue
#SBATCH --open-mode=append
# sbatch docker/slurm.sh PHOTOS OUT [options of splatpipe run]
#
# One capture as a job, by Apptainer from the same image (apptainer build splatpipe.sif docker-daemon://splatpipe:cpu), or by a
# splatpipe on PATH where SPLATPIPE_IMAGE is empty. A minute before its time is over the job is told to end; what it finished
# is kept, it is queued again, and goes on from there. With a GPU: #SBATCH --gres=gpu:1, the cuda image, and --nv below.
set -euo pipefail

photos=$(realpath "$1")
out=$(realpath -m "$2")
shift 2
image=${SPLATPIPE_IMAGE-splatpipe.sif}
mkdir -p "$out"

if [ -n "$image" ]; then
  command=(apptainer run --containall --no-home --bind "$photos:/photos:ro" --bind "$out:/out" "$image" run /photos /out --wait "$@")
else
  command=(splatpipe run "$photos" "$out" --wait "$@")
fi

# Slurm signals this shell alone: it hands that on, and waits for the end. USR1 is the time that is nearly over, TERM is scancel
# (or a preemption, after which Slurm itself may queue it again): whoever cancels a job does not want it back.
again=
"${command[@]}" &
job=$!
trap 'kill -TERM "$job"' TERM
trap 'again=1; kill -TERM "$job"' USR1
code=0
wait "$job" || code=$?
while kill -0 "$job" 2>/dev/null; do # the trap ended the first wait
  code=0
  wait "$job" || code=$?
done

if [ "$code" = 143 ] && [ -n "$again" ] && [ -n "${SLURM_JOB_ID:-}" ]; then # terminated, not failed
  scontrol requeue "$SLURM_JOB_ID"
fi
exit "$code"
