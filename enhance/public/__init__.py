"""The public enhancers behind the same call: their files' layouts, read strictly, and their graphs, rewritten where that is exact.

Images are `[B, 3, H, W]` in 0..1 at each model's border and -1..1 inside it. Layouts are those that the models' own repositories write:
NVIDIA/harmonizer, nv-tlabs/Fixer, nv-tlabs/Difix3D, nvidia-cosmos/cosmos-predict2, Wan-Video/Wan2.1, ZHKKKe/Harmonizer and
huggingface/diffusers.
"""
