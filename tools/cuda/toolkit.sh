#!/usr/bin/env bash
# Makes NVIDIA's wheels in a virtual environment a toolkit to build with: libraries without versions in their names, cuDNN beside
# them, and a driver to link against. Usage: tools/cuda/toolkit.sh VENV; the toolkit is VENV/cuda.
set -euo pipefail
venv=$1
packages=$("$venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/nvidia
ln -sfn "$packages/cu13" "$venv/cuda"
cd "$packages/cu13"
for file in ../cudnn/lib/*.so.* lib/*.so.*; do
    name=${file##*/}
    [ "$file" = "lib/$name" ] || ln -sf "../$file" "lib/$name"
    ln -sf "$name" "lib/${name%%.so.*}.so"
done
for file in ../cudnn/include/*.h; do ln -sf "../$file" include/; done
# The driver comes with the machine. Any library with its names will do to link.
mkdir -p lib/stubs
grep -ohE '\bcu[A-Z][A-Za-z0-9_]*' include/cuda.h include/cudaProfilerTypedefs.h | sort -u |
    sed 's/.*/void &(void) {}/' | cc -shared -Wl,-soname,libcuda.so.1 -x c -o lib/stubs/libcuda.so -
