#!/usr/bin/env bash
# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# PyArrow 26.0.1, pandas 3.1.1, NumPy 2.4.6. A log with a flow that is 0, then moves, and misses a value (NaN) in either
# part. Its rows with a flow other than 0: expected the rows that the same filter finds in the table, both NaN among
# them, however the file is laid out. Seen: written in two row groups the file gives one NaN row and not the other, by
# PyArrow and by pandas, since the group with 0 and NaN alone counts as all 0; and so for "not at most 1". In one row
# group both are found, and so are they by "not in [0]".
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --quiet --disable-pip-version-check install pyarrow==26.0.1 pandas==3.1.1 numpy==2.4.6
cd "$folder"
venv/bin/python -W ignore - <<'PY'
import numpy as np
import pandas
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

nan = np.nan
table = pa.table({"row": np.arange(8), "flow": np.array([0.0, 0.0, nan, 0.0, 1.0, 2.0, nan, 4.0])})
pq.write_table(table, "one.parquet")
pq.write_table(table, "two.parquet", row_group_size=4)
flow = pc.field("flow")


def rows(found):
    return found["row"].to_pylist()


for name, where, right, seen in (
    ("flow != 0", flow != 0.0, [2, 4, 5, 6, 7], [4, 5, 6, 7]),
    ("not flow <= 1", ~(flow <= 1.0), [2, 5, 6, 7], [5, 6, 7]),
    ("flow not in [0]", [("flow", "not in", [0.0])], [2, 4, 5, 6, 7], [2, 4, 5, 6, 7]),
):
    one, two = (rows(pq.read_table(f"{file}.parquet", filters=where)) for file in ("one", "two"))
    print(name, one, two)
    assert one == right and two == seen
    assert isinstance(where, list) or rows(table.filter(where)) == right
of_pandas = pandas.read_parquet("two.parquet", filters=[("flow", "!=", 0.0)])["row"].tolist()
print("pandas", of_pandas)
assert of_pandas == [4, 5, 6, 7]
PY
