"""Mistakes to plant into the sources of the CUDA kernels that take activated values and plain features."""

from __future__ import annotations

from faults import KernelFault

FEATURE_FAULTS = (
    KernelFault(
        "no barrier between a batch's staging and its blending",
        "cuda/blend_features.cuh",
        "stage(job, list, from, batch);\n        __syncthreads();",
        "stage(job, list, from, batch);\n        if (!FAULT) __syncthreads();",
    ),
    KernelFault(
        "a batch is staged over the last one while that is read",
        "cuda/blend_features.cuh",
        "if (!__syncthreads_or(canvas.alive)) break;",
        "if (!FAULT && !__syncthreads_or(canvas.alive)) break;",
    ),
    KernelFault(
        "a pixel ends one Gaussian late",
        "cuda/blend_features.cuh",
        "canvas->alive = false, canvas->end = pair;\n        return;",
        "canvas->alive = false, canvas->end = pair + FAULT;\n        if (!FAULT) return;",
    ),
    KernelFault(
        "alpha has the line's cap",
        "cuda/blend_features.cuh",
        "fminf(power_of_two(log2_alpha), job.alpha_max) * before,",
        "fminf(power_of_two(log2_alpha), FAULT ? kAlphaMax : job.alpha_max) * before,",
    ),
    KernelFault(
        "every group blends the first channels",
        "cuda/blend_features.cuh",
        "(row + first + 4 * q);",
        "(row + (FAULT ? 0 : first) + 4 * q);",
    ),
    KernelFault(
        "a splat's features are found by its slot",
        "cuda/features.cu",
        "record.red = __uint_as_float(static_cast<uint32_t>(i));",
        "record.red = __uint_as_float(static_cast<uint32_t>(FAULT ? i / 2 : i));",
    ),
    KernelFault(
        "the last channel is the same all over a splat",
        "cuda/blend_features.cuh",
        "if (kSlanted && group.first + c == features.channels - 1) sum += canvas.slant;",
        "if (!FAULT && kSlanted && group.first + c == features.channels - 1) sum += canvas.slant;",
    ),
    KernelFault(
        "a group's background is the first one's",
        "cuda/blend_features.cuh",
        "features.background + group.first : nullptr",
        "features.background + (FAULT ? 0 : group.first) : nullptr",
    ),
    KernelFault(
        "no barrier between the warps' gradients and their sum",
        "cuda/blend_features_back.cuh",
        "last_here - from, &canvas, batch);\n        __syncthreads();",
        "last_here - from, &canvas, batch);\n        if (!FAULT) __syncthreads();",
    ),
    KernelFault(
        "no barrier before a batch is staged over the last one, backward",
        "cuda/blend_features_back.cuh",
        "put_feature_slots<Of>(features, *batch, to - from);\n        __syncthreads();",
        "put_feature_slots<Of>(features, *batch, to - from);\n        if (!FAULT) __syncthreads();",
    ),
    KernelFault(
        "channels behind the first group have no share in the gradient of alpha",
        "cuda/blend_features_back.cuh",
        "c < job.channels; ++c)\n            value =",
        "c < job.channels && !FAULT; ++c)\n            value =",
    ),
    KernelFault(
        "the background forgotten on the way back",
        "cuda/blend_features_back.cuh",
        "if (canvas.planes && features.background)",
        "if (canvas.planes && features.background && !FAULT)",
    ),
    KernelFault(
        "capped alphas have a gradient",
        "cuda/blend_features_back.cuh",
        "log2_alpha <= job.log2_alpha_max ?",
        "log2_alpha <= job.log2_alpha_max || FAULT ?",
    ),
    KernelFault(
        "the magnitudes of all pixels together, not of each",
        "cuda/blend_features_back.cuh",
        "values[Of::kRowSizes] = fabsf(gu);",
        "values[Of::kRowSizes] = FAULT ? gu : fabsf(gu);",
    ),
    KernelFault(
        "a splat's slant along v is taken for that along u",
        "cuda/blend_features_back.cuh",
        "row_value == 3 && power == 1) return kSlants + 2;",
        "row_value == 3 && power == 1) return FAULT ? -1 : kSlants + 2;",
    ),
    KernelFault(
        "the last warp lost from a gradient's sum",
        "cuda/blend_features_back.cuh",
        "for (int warp = 0; warp < kWarps; ++warp)",
        "for (int warp = 0; warp < kWarps - FAULT; ++warp)",
    ),
    KernelFault(
        "slots of pairs that no pixel processed are left as they were",
        "cuda/blend_features_back.cuh",
        "clear_feature_slots<Of>(features, list, last);",
        "if (!FAULT) clear_feature_slots<Of>(features, list, last);",
    ),
    KernelFault(
        "gradients of features are written over what is there",
        "cuda/blend_features_back.cuh",
        "float sum = *total;",
        "float sum = FAULT ? 0.0f : *total;",
    ),
    KernelFault(
        "sums of moments do not start at zero",
        "cuda/features.cu",
        "cudaMemsetAsync(features.sums, 0, bytes,",
        "cudaMemsetAsync(features.sums, 0, FAULT ? 0 : bytes,",
    ),
    KernelFault(
        "groups behind the first have no gradient in chunks that nobody foresaw",
        "cuda/features.cu",
        "number = 1; number < groups_of(features); ++number) {",
        "number = 1; number < groups_of(features) && !FAULT; ++number) {",
    ),
    KernelFault(
        "no barrier of the grid between gradients that nobody foresaw and their sums",
        "cuda/features.cu",
        "sync_grid();\n        sum_feature_slots<Of>(",
        "if (!FAULT) sync_grid();\n        sum_feature_slots<Of>(",
    ),
    KernelFault(
        "chunks that nobody foresaw are not worked off",
        "cuda/features.cu",
        "bin_chunk(job, chunk);\n        for (int number = 0;",
        "if (FAULT) return;\n        bin_chunk(job, chunk);\n        for (int number = 0;",
    ),
    KernelFault(
        "opacities have the gradient of their logarithm",
        "cuda/features.cu",
        "m.s / in.opacities[i];",
        "m.s / (FAULT ? 1.0f : in.opacities[i]);",
    ),
    KernelFault(
        "Gaussians that are not visible get a gradient",
        "cuda/activated.cu",
        "if (i >= in.count || radii[2 * i] <= 0) return;",
        "if (i >= in.count || (radii[2 * i] <= 0 && !FAULT)) return;",
    ),
    KernelFault(
        "no barrier between a block's bases and the rows they go to",
        "cuda/activated.cu",
        "&staged));\n    __syncthreads();",
        "&staged));\n    if (!FAULT) __syncthreads();",
    ),
    KernelFault(
        "the coefficients' rows lie as close as they are used",
        "cuda/activated.cu",
        "sh[(first + row) * width + column] +=",
        "sh[(first + row) * (FAULT ? kUsed : width) + column] +=",
    ),
    KernelFault(
        "the centre of projection is that of a pose that does not scale",
        "cuda/activated.cu",
        "view->centre[k] = static_cast<float>(in->centre[k]);",
        "view->centre[k] = FAULT ? view->centre[k] : static_cast<float>(in->centre[k]);",
    ),
    KernelFault(
        "the floor of the anti-aliased factor has a gradient",
        "raster/features_math.h",
        "*free = at_most(floor, ratio);",
        "*free = FAULT || at_most(floor, ratio);",
    ),
    KernelFault(
        "what reaches the camera's plane is seen",
        "raster/features_math.h",
        "less(dot(reach, reach), p.point.z * p.point.z)",
        "less(FAULT ? fill(0.0f) : dot(reach, reach), p.point.z * p.point.z)",
    ),
    KernelFault(
        "the depth has no gradient by the centre",
        "raster/features_math.h",
        "const Floats dz = by.depth - ",
        "const Floats dz = (FAULT ? fill(0.0f) : by.depth) - ",
    ),
)
