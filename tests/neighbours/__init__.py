# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
