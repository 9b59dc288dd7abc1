# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# The two commands, `make run` and `make test`, on a machine that has nothing but containers:
#
#     docker build -t pdeloop .
#     docker run --rm -v "$PWD/runs:/pdeloop/runs" pdeloop
#     docker run --rm pdeloop make test
#
# The image has a compiler, git and make. Nodes talk over loopback, which each container has of its own.
FROM python:3.11-bookworm
WORKDIR /pdeloop
COPY . .
RUN make setup
ENV PATH="/pdeloop/.venv/bin:$PATH"
CMD ["make", "run"]
