"""Measure the time of a training iteration, by part: ``train_speed --data DATASET --threads N --json FILE``.

Training's own code at a fixed number of Gaussians, over all photos in turn; each point set of the dataset (`sparse`,
`sparse_100k`) at each size, every case in a process of its own. Reports medians and minima over the iterations; `alone`
is the rasterizer's forward and backward pass afterwards, over the same photos, without the rest of training.
"""

from __future__ import annotations

import json

from measure import (
    InitialSettings,
    Row,
    TimingCase,
    machine,
    parse,
    parser,
    point_sets,
    prepare,
    report,
    run_apart,
    scratch,
    size_factor,
    time_case,
)

from splatpipe.pipeline.mvs.options import InitializeConfig

COLUMNS = {
    "points": "points:",
    "Gauss.": "gaussians:,",
    "MP": "megapixels:.2f",
    "threads": "threads:",
    "wall ms": "wall_s:ms",
    "shortest": "wall_min_s:ms",
    "CPU ms": "cpu_s:ms",
    "forward": "forward_wall_s:ms",
    "loss": "loss_wall_s:ms",
    "backward": "backward_wall_s:ms",
    "Adam": "adam_wall_s:ms",
    "rest": "rest_wall_s:ms",
    "pairs/px": "pairs_per_pixel:.1f",
    "Gpair/s/core": "gpairs_per_s_per_core:.3f",
    "alone ms": "alone_wall_s:ms",
    "alone Gpair/s/core": "alone_gpairs_per_s_per_core:.3f",
    "FLOP/pair": "flop_slots_per_pair:.0f",
    "peak MB": "peak_bytes:MB",
}


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--megapixels", type=float, nargs="+", default=[0.1, 0.4, 1.6])
    options.add_argument("--points", nargs="+", help="names of the point sets; all without any")
    options.add_argument("--sh-degree", type=int, default=3, choices=range(4))
    options.add_argument("--max-angle", type=float, default=0.1, help="initialize.max_angle; 1 leaves sizes uncapped")
    options.add_argument("--no-statistics", action="store_true", help="as in the half without density control")
    options.add_argument("--repeats", type=int, default=30, help="iterations that count")
    options.add_argument("--warmup", type=int, default=5, help="iterations before them, at least an epoch")
    arguments = parse(options)
    if arguments.case is not None:
        print(json.dumps(time_case(TimingCase(**json.loads(arguments.case)))))
        return
    facts = machine(arguments.threads)
    rows: list[Row] = []
    start = InitialSettings(InitializeConfig(max_angle=arguments.max_angle, dense=False))
    with scratch() as folder:
        for points in arguments.points or [path.name for path in point_sets(arguments.data)]:
            for megapixels in arguments.megapixels:
                factor = size_factor(arguments.data, megapixels)
                dataset = prepare(arguments.data, points, factor, folder / f"{points}-{megapixels}", start=start)
                case = TimingCase(
                    str(dataset),
                    str(dataset / "init.ply"),
                    arguments.threads,
                    arguments.repeats,
                    arguments.warmup,
                    arguments.sh_degree,
                    statistics=not arguments.no_statistics,
                )
                row = {"points": points} | run_apart("train_speed", case)
                # Multiplications and additions that the core could have executed in the time of a pair.
                row["flop_slots_per_pair"] = facts["fma_gflops_per_core"] / row["gpairs_per_s_per_core"]
                rows.append(row)
    report("train_speed", facts, rows, COLUMNS, arguments.json)


if __name__ == "__main__":
    main()
