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
# One capture as a job, by Apptainer from the same image (apptainer build splatpipe.sif docker-daemon://splatpipe:cpu), or
# by a splatpipe on PATH if SPLATPIPE_IMAGE is empty. A minute before its time limit, the job is signalled to end; finished
# work is kept, and the job is requeued and resumes. With a GPU: #SBATCH --gres=gpu:1, the cuda image, and --nv below.
set -euo pipefail

lacks() {
  echo "splatpipe: $1" >&2
  exit 4
}

[ $# -ge 2 ] || { echo "usage: sbatch $0 PHOTOS OUT [options of splatpipe run]" >&2; exit 2; }
photos=$(realpath "$1")
out=$(realpath -m "$2")
shift 2
image=${SPLATPIPE_IMAGE-splatpipe.sif}
mkdir -p "$out"

if [ -n "$image" ]; then
  command -v apptainer > /dev/null || lacks "there is no apptainer on $(hostname). Load its module before sbatch, or set SPLATPIPE_IMAGE= (empty) for a splatpipe on PATH."
  [ -e "$image" ] || lacks "there is no image $image. Set SPLATPIPE_IMAGE to its path, or to nothing for a splatpipe on PATH."
  command=(apptainer run --containall --no-home --bind "$photos:/photos:ro" --bind "$out:/out" "$image" run /photos /out --wait "$@")
else
  command -v splatpipe > /dev/null || lacks "there is no splatpipe on PATH on $(hostname). Activate its environment before sbatch, or set SPLATPIPE_IMAGE to an image for Apptainer."
  command=(splatpipe run "$photos" "$out" --wait "$@")
fi

# Slurm signals only this shell, which forwards the signal and waits for the end. USR1 means that the time limit is near,
# TERM is scancel (or a preemption, after which Slurm itself may requeue the job): a cancelled job must not be requeued.
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
