"""Mistakes to plant into the CUDA kernels' sources, and the planting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from building import HARNESS, NATIVE, build_on_cpu, kernel_sources

ALIVE = "FAULT"
"""In a replacement: whether this fault is the active one, so that one library can contain all of them."""


@dataclass(frozen=True)
class KernelFault:
    """A mistake to plant.

    Attributes:
        name: Description of the mistake.
        file: Path relative to `native`.
        snippet: Original text, exactly once in the file.
        instead: Replacement; equivalent as long as ``ALIVE`` is false.
    """

    name: str
    file: str
    snippet: str
    instead: str


FAULTS = (
    KernelFault(
        "no barrier between the warps' sums and their reading",
        "cuda/scan.cuh",
        "shared->warps[warp_index()] = inclusive;\n    __syncthreads();",
        "shared->warps[warp_index()] = inclusive;\n    if (!FAULT) __syncthreads();",
    ),
    KernelFault(
        "no barrier before the warps' sums are written again",
        "cuda/scan.cuh",
        "__syncthreads();  // before `shared` is used again",
        "if (!FAULT) __syncthreads();",
    ),
    KernelFault(
        "no barrier between a batch's staging and its blending",
        "cuda/blend.cuh",
        "stage(job, list, from, batch);\n        __syncthreads();",
        "stage(job, list, from, batch);\n        if (!FAULT) __syncthreads();",
    ),
    KernelFault(
        "no barrier between the warps' gradients and their sum",
        "cuda/blend_back.cuh",
        "&canvas, batch);\n        __syncthreads();",
        "&canvas, batch);\n        if (!FAULT) __syncthreads();",
    ),
    KernelFault(
        "no barrier before a batch is staged over the last one, backward",
        "cuda/blend_back.cuh",
        "put_slots(job, *batch, to - from);\n        __syncthreads();",
        "put_slots(job, *batch, to - from);\n        if (!FAULT) __syncthreads();",
    ),
    KernelFault(
        "no barrier between clearing and counting the digits of a block",
        "cuda/sort.cuh",
        "counts.of[threadIdx.x] = 0;\n        __syncthreads();",
        "counts.of[threadIdx.x] = 0;\n        if (!FAULT) __syncthreads();",
    ),
    KernelFault(
        "no meeting of the warp between reading and writing its counts",
        "cuda/sort.cuh",
        "const uint32_t counted = counts[digit];\n        __syncwarp(kWholeWarp);",
        "const uint32_t counted = counts[digit];\n        if (!FAULT) __syncwarp(kWholeWarp);",
    ),
    KernelFault(
        "half a warp does not come to the vote",
        "cuda/blend.cuh",
        "const unsigned pairs = __ballot_sync(kWholeWarp, touched >> sub & 1);",
        "const unsigned pairs = FAULT && lane > 15 ? 0u : __ballot_sync(kWholeWarp, touched >> sub & 1);",
    ),
    KernelFault(
        "rows and columns of tiles swapped in blending",
        "cuda/blend.cuh",
        "return {tile, tile % job.view.tiles_x * kTile, tile / job.view.tiles_x * kTile,",
        "const int swapped = FAULT ? job.tiles / job.view.tiles_x : job.view.tiles_x;\n"
        "    return {tile, (FAULT ? tile / swapped : tile % swapped) * kTile,\n"
        "            (FAULT ? tile % swapped : tile / swapped) * kTile,",
    ),
    KernelFault(
        "rows and columns of tiles swapped in the lists",
        "cuda/bin.cuh",
        "const int left = row * view.tiles_x;",
        "const int left = row * (FAULT ? (view.height + kTile - 1) / kTile : view.tiles_x);",
    ),
    KernelFault(
        "the last warp lost from a gradient's sum",
        "cuda/blend_back.cuh",
        "for (int warp = 0; warp < kWarps; ++warp)",
        "for (int warp = 0; warp < kWarps - FAULT; ++warp)",
    ),
    KernelFault(
        "lanes sixteen apart not added up",
        "cuda/blend_back.cuh",
        "values[i] = kept + __shfl_xor_sync(kWholeWarp, given, kOffset);",
        "const float opposite = __shfl_xor_sync(kWholeWarp, given, kOffset);\n"
        "            values[i] = FAULT && kOffset == 16 ? kept : kept + opposite;",
    ),
    KernelFault(
        "the first warp lost from the places of digits",
        "cuda/sort.cuh",
        "for (int warp = 0; warp < kWarps; ++warp) count += shared->warps[warp][digit];",
        "for (int warp = FAULT; warp < kWarps; ++warp) count += shared->warps[warp][digit];",
    ),
    KernelFault(
        "a chunk one tile too long",
        "cuda/bin.cuh",
        "return fits;",
        "return fits + FAULT;",
    ),
    KernelFault(
        "a splat's tiles go on behind the chunk's last",
        "cuda/bin.cuh",
        "end = min(left + span.last, tiles.end);",
        "end = min(left + span.last, tiles.end + FAULT);",
    ),
    KernelFault(
        "a chunk's list found from the view's first pair",
        "cuda/blend.cuh",
        "job.at.pair_values[0] + (begin - job.at.tile_begin[first_tile])",
        "job.at.pair_values[0] + (begin - (FAULT ? 0 : job.at.tile_begin[first_tile]))",
    ),
    KernelFault(
        "chunks that nobody foresaw are not worked off",
        "cuda/frame.cu",
        "bin_chunk(job, chunk);\n        blend_tiles<kDepth>",
        "if (FAULT) return;\n        bin_chunk(job, chunk);\n        blend_tiles<kDepth>",
    ),
    KernelFault(
        "no barrier of the grid before the lists that nobody foresaw are blended",
        "cuda/bin.cuh",
        "scatter_digits(tile_pass(job.at, pass));\n    }\n    sync_grid();",
        "scatter_digits(tile_pass(job.at, pass));\n    }\n    if (!FAULT) sync_grid();",
    ),
    KernelFault(
        "no barrier of the grid between gradients that nobody foresaw and their sums",
        "cuda/frame.cu",
        "sync_grid();\n        sum_slots<kDepth>(job, chunk);",
        "if (!FAULT) sync_grid();\n        sum_slots<kDepth>(job, chunk);",
    ),
    KernelFault(
        "no barrier of the grid before the next chunk that nobody foresaw",
        "cuda/frame.cu",
        "sum_slots<kDepth>(job, chunk);\n        sync_grid();",
        "sum_slots<kDepth>(job, chunk);\n        if (!FAULT) sync_grid();",
    ),
    KernelFault(
        "the last Gaussian's slots end where they begin",
        "cuda/blend_back.cuh",
        "job.at.offsets[rank + 1] : header.chunk_pairs;",
        "job.at.offsets[rank + 1] : FAULT ? begin : header.chunk_pairs;",
    ),
    KernelFault(
        "the tiles' keys lose their upper bits",
        "cuda/bin.cuh",
        "static_cast<uint16_t>(tile - tiles.begin)",
        "static_cast<uint16_t>((tile - tiles.begin) & (FAULT ? 255 : -1))",
    ),
    KernelFault(
        "ranks of equal keys the wrong way round",
        "cuda/sort.cuh",
        "before = alike & before_me;",
        "before = alike & (FAULT ? ~before_me & ~(1u << lane_index()) : before_me);",
    ),
    KernelFault(
        "a pixel ends one Gaussian late",
        "cuda/blend.cuh",
        "canvas->alive = false, canvas->end = pair;\n        return;",
        "canvas->alive = false, canvas->end = pair + FAULT;\n        if (!FAULT) return;",
    ),
    KernelFault(
        "pixels beside the picture are blended",
        "cuda/blend.cuh",
        "x < view.width && y < view.height};",
        "(x < view.width || FAULT) && y < view.height};",
    ),
    KernelFault(
        "slots that no pixel looked at are not cleared",
        "cuda/blend_back.cuh",
        "clear_slots<Of::kFloats>(job, list, last);",
        "if (!FAULT) clear_slots<Of::kFloats>(job, list, last);",
    ),
    KernelFault(
        "sums of Gaussians do not start at zero",
        "cuda/frame.cu",
        "cudaMemsetAsync(job.back.sums, 0, bytes,",
        "cudaMemsetAsync(job.back.sums, 0, FAULT ? 0 : bytes,",
    ),
    KernelFault(
        "what is behind a pair counts with the wrong sign",
        "cuda/blend_back.cuh",
        "fmaf(-share, canvas->behind, light)",
        "fmaf(FAULT ? share : -share, canvas->behind, light)",
    ),
    KernelFault(
        "the background forgotten on the way back",
        "cuda/blend_back.cuh",
        "canvas.behind = (by_left - ",
        "canvas.behind = ((FAULT ? 0.0f : by_left) - ",
    ),
    KernelFault(
        "gradients of Gaussians that are not visible are left as they were",
        "cuda/step.cu",
        "stage_zero(staged.of[thread]);\n            means2d",
        "if (!FAULT) stage_zero(staged.of[thread]);\n            means2d",
    ),
    KernelFault(
        "no barrier between a block's gradients and the rows they go to",
        "cuda/step.cu",
        "mean2d[1];\n        }\n        __syncthreads();",
        "mean2d[1];\n        }\n        if (!FAULT) __syncthreads();",
    ),
    KernelFault(
        "no barrier between a block's gradients and its step",
        "cuda/step.cu",
        "if (__syncthreads_or(steps)) step_tensors(",
        "if (FAULT || __syncthreads_or(steps)) step_tensors(",
    ),
    KernelFault(
        "no barrier between a block's turns of gradients",
        "cuda/step.cu",
        "sh_count); });\n        __syncthreads();",
        "sh_count); });\n        if (!FAULT) __syncthreads();",
    ),
    KernelFault(
        "Gaussians around those that are trained step, too",
        "cuda/step.cu",
        "const int64_t n = step.rows;",
        "const int64_t n = FAULT ? job.model.count : step.rows;",
    ),
    KernelFault(
        "Gaussians that are not visible step, too",
        "cuda/step.cu",
        "bool steps = !step.sparse;",
        "bool steps = !step.sparse || FAULT;",
    ),
    KernelFault(
        "the constant band's rate for all bands",
        "cuda/step.cu",
        "return column < 3 ? step.rates[4]",
        "return column < 3 || FAULT ? step.rates[4]",
    ),
    KernelFault(
        "both halves of a split from the same draws",
        "cuda/density.cu",
        "2 * static_cast<uint64_t>(row) + (i >= count);",
        "2 * static_cast<uint64_t>(row) + (i >= count && !FAULT);",
    ),
    KernelFault(
        "axes of the Morton curve the wrong way round",
        "cuda/density.cu",
        "kLast))) << axis;",
        "kLast))) << (FAULT ? 2 - axis : axis);",
    ),
    KernelFault(
        "one tap of the loss's window on the wrong side",
        "cuda/loss.cu",
        "p[(kRadius - d) * kChannels] + p[(kRadius + d) * kChannels]",
        "p[(kRadius - d) * kChannels] + p[(kRadius + (FAULT && d == 2 ? -d : d)) * kChannels]",
    ),
    KernelFault(
        "the loss's difference with the wrong sign",
        "cuda/loss.cu",
        "v > 0.0f ? 1.0f : (v < 0.0f ? -1.0f : 0.0f)",
        "(FAULT ? -v : v) > 0.0f ? 1.0f : ((FAULT ? -v : v) < 0.0f ? -1.0f : 0.0f)",
    ),
    KernelFault(
        "pixels beside those that count have a share of the loss",
        "cuda/loss.cu",
        "const bool counts_here = is_inner(job, row, col) &&",
        "const bool counts_here = (FAULT || is_inner(job, row, col)) &&",
    ),
    KernelFault(
        "pixels beside those that count have L1's gradient",
        "cuda/loss.cu",
        "const float l1 = is_inner(job, row, col) ?",
        "const float l1 = FAULT || is_inner(job, row, col) ?",
    ),
    KernelFault(
        "a column beside those that count counts",
        "cuda/loss.cu",
        "col < job.inner.right &&",
        "col < job.inner.right + (FAULT ? 1 : 0) &&",
    ),
    KernelFault(
        "what reaches the camera's plane is seen",
        "raster/splat_math.h",
        "less(dot(reach, reach), p.point.z * p.point.z)",
        "less(FAULT ? fill(0.0f) : dot(reach, reach), p.point.z * p.point.z)",
    ),
    KernelFault(
        "a part of a picture has limits of its own",
        "raster/view.h",
        "margin_x = kFrustumMargin * 0.5 * shot.whole_width",
        "margin_x = kFrustumMargin * 0.5 * (FAULT ? shot.width : shot.whole_width)",
    ),
    KernelFault(
        "a part of a picture lies elsewhere in it",
        "raster/view.h",
        "cx = shot.cx + shot.left,",
        "cx = shot.cx + (FAULT ? 0 : shot.left),",
    ),
    KernelFault(
        "no barrier before the loss's rows are read",
        "cuda/loss.cu",
        "blur_pictures(job, tile, &shared.means);\n    __syncthreads();",
        "blur_pictures(job, tile, &shared.means);\n    if (!FAULT) __syncthreads();",
    ),
)


def planted(faults: Sequence[KernelFault] = FAULTS, name: str = "splat_cuda_with_faults") -> Path:
    """Return the kernels with all faults planted, none active until ``harness_fault`` sets its number, from 1.

    Args:
        faults: Mistakes to plant.
        name: Name of the library.

    Raises:
        AssertionError: if a snippet does not occur in its file exactly once.
    """
    texts: dict[Path, str] = {}
    for number, fault in enumerate(faults, start=1):
        path = NATIVE / fault.file
        text = path.read_text()
        assert text.count(fault.snippet) == 1, f"{fault.file} has '{fault.snippet}' {text.count(fault.snippet)} times"
        changed = texts.get(path, text)
        assert changed.count(fault.snippet) == 1, f"two faults in one place of {fault.file}: {fault.name}"
        texts[path] = changed.replace(fault.snippet, fault.instead.replace(ALIVE, f"(::harness::fault() == {number})"))
    texts = {path: f'#include "base/device.h"\n{text}' for path, text in texts.items()}  # which includes the harness
    return build_on_cpu([*kernel_sources(), HARNESS / "peek.cu"], name, changed=texts)
