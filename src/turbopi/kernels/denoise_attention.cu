// Part 6 of 7: queries, keys and values of the suffix, and attention. The keys are split over the ranks of the head's
// cluster.

__device__ __forceinline__ void ldmatrix(uint4& v, u32 address) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0,%1,%2,%3}, [%4];"
               : "=r"(v.x), "=r"(v.y), "=r"(v.z), "=r"(v.w)
               : "r"(address));
}
__device__ __forceinline__ void ldmatrix_transposed(uint4& v, u32 address) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0,%1,%2,%3}, [%4];"
               : "=r"(v.x), "=r"(v.y), "=r"(v.z), "=r"(v.w)
               : "r"(address));
}

constexpr int ITEMS_Q =
    most((QTL + KVL) * NT, W);  // (tile, 8 tokens) of queries, keys and values that one warp finishes

// Cosine and sine of a warp's items, for tokens 2t and 2t + 1; values aren't turned.
__device__ __forceinline__ void make_rope(const Block& b, int prefix, float2 (&rope)[ITEMS_Q][2]) {
#pragma unroll
  for (int j = 0; j < ITEMS_Q; ++j) {
    const int i = b.warp + j * W, qn = b.qn(), kvn = b.kvn(), k = i - qn * NT;
    rope[j][0] = rope[j][1] = make_float2(1, 0);
    if (!b.attends() || i >= (qn + kvn) * NT) continue;
    const int tile = k < 0 ? b.q0() + i % qn : b.kv0() + (KVL == 1 ? 0 : k % kvn), n = k < 0      ? i / qn
                                                                                       : KVL == 1 ? k
                                                                                                  : k / kvn;
    if (k >= 0 && tile >= QT) continue;
#pragma unroll
    for (int h = 0; h < 2; ++h) {
      float sine, cosine;
      sincosf(float(prefix + n * 8 + 2 * b.t() + h) * b.a.inv_freq[tile * 8 + b.g()], &sine, &cosine);
      rope[j][h] = make_float2(cosine, sine);
    }
  }
}

// q to all ranks (standard order), k and v to all clusters as float32 with their flags. The partial sums lie over the
// stream; queries are sent when all of those have been read, so what a peer sends after it has them may lie there too.
__device__ __forceinline__ void project(Block& b, const float* shifted, const float* row_scales, float* kv, u32 bit,
                                        const float2 (&rope)[ITEMS_Q][2]) {
  const int qn = b.qn(), kvn = b.kvn();
  float2 shift[ITEMS_Q], scale[ITEMS_Q];
#pragma unroll
  for (int j = 0; j < ITEMS_Q; ++j) {
    const int i = b.warp + j * W, k = i - qn * NT;
    const int tile = i >= (qn + kvn) * NT ? 0 : k < 0 ? i % qn : QTL + (KVL == 1 ? 0 : k % kvn);
    shift[j] = make_float2(__ldg(shifted + tile * 16 + b.g()), __ldg(shifted + tile * 16 + b.g() + 8));
    if (FP8) scale[j] = make_float2(__ldg(row_scales + tile * 16 + b.g()), __ldg(row_scales + tile * 16 + b.g() + 8));
  }
  float sums[plan_groups(QTL + KVL)][NT * 4];
  multiply<QTL + KVL, D16>(b, b.base + M_X, D16, qn + kvn, sums);
  MARK(1)
  consumers_sync();
  store_partials<QTL + KVL>(b, b.smem + M_X, qn + kvn, sums);
  consumers_sync();
  u32 first[ITEMS_Q], second[ITEMS_Q];
#pragma unroll
  for (int j = 0; j < ITEMS_Q; ++j) {
    const int i = b.warp + j * W, k = i - qn * NT;
    first[j] = second[j] = 0;
    if (i < (qn + kvn) * NT) {
      const int n = k < 0      ? i / qn
                    : KVL == 1 ? k
                               : k / kvn,
                kv_tile = KVL == 1 ? 0 : k % kvn, token = n * 8 + 2 * b.t();
      float4 c = total<QTL + KVL>(b, b.smem + M_X, k < 0 ? i % qn : qn + kv_tile, n);
      if (FP8) c = make_float4(c.x * scale[j].x, c.y * scale[j].x, c.z * scale[j].y, c.w * scale[j].y);
      const float2 r = inverse_rms(b, token), u = rope[j][0], v = rope[j][1];
      const float a0 = c.x * r.x + shift[j].x, a1 = c.z * r.x + shift[j].y, c0 = c.y * r.y + shift[j].x,
                  c1 = c.w * r.y + shift[j].y;
      const float f0 = a0 * u.x - a1 * u.y, s0 = a1 * u.x + a0 * u.y, f1 = c0 * v.x - c1 * v.y,
                  s1 = c1 * v.x + c0 * v.y;
      if (k < 0) {
        const float f = exchange(b.g() & 1 ? f0 : f1, 4), s = exchange(b.g() & 1 ? s0 : s1, 4);
        first[j] = b.g() & 1 ? pack(f, f1) : pack(f0, f), second[j] = b.g() & 1 ? pack(s, s1) : pack(s0, s);
      } else {
        const int tile = b.kv0() + kv_tile, col = tile < QT ? tile * 8 + b.g() : HD + (tile - QT) * 16 + b.g(),
                  up = tile < QT ? HD / 2 : 8;
        float* p = kv + size_t(token) * 2 * HD + col;
        if (token < T) publish(p, f0, bit), publish(p + up, s0, bit);
        if (token + 1 < T) publish(p + 2 * HD, f1, bit), publish(p + 2 * HD + up, s1, bit);
      }
    }
  }
  consumers_sync();
#pragma unroll
  for (int j = 0; j < ITEMS_Q; ++j) {
    const int i = b.warp + j * W;
    if (i < qn * NT) {
      const int n = i / qn, token = 2 * b.t() + (b.g() & 1), even = (b.q0() + i % qn) * 8 + (b.g() & ~1);
      const Everyone bars(b.bar(BAR_Q));
      if (n * 8 + token < T)
#pragma unroll
        for (int h = 0; h < 2; ++h) {
          const int col = even + h * (HD / 2), in = col & 15;
          const u32 to =
              b.base + M_H + H_Q + ((col >> 4) * NT + n) * 256 + (token * 4 + ((in & 7) >> 1)) * 8 + (in >> 3) * 4;
          const Everyone data(to);
#pragma unroll
          for (int d = 0; d < S; ++d) send(data.at[d], h ? second[j] : first[j], bars.at[d]);
        }
    }
  }
  if (IDLE_Q && threadIdx.x < S) send(at_rank(b.base + M_TOKEN, threadIdx.x), 0, at_rank(b.bar(BAR_Q), threadIdx.x));
}
constexpr u32 Q_EXPECT = HD * T * 2 + (IDLE_Q ? S * 4 : 0);

// Logits of 16 keys, times the scale and log2 e, to shared memory. Two warps (`half`) share them: by columns, whose
// sums softmax adds up, or else by tokens. fetch(k) is the k-th fragment of the keys. Returns a word that needs all it
// read, for give_slot.
constexpr int HALF = SPLIT_KEYS ? NT : (NT + 1) / 2;
template <typename Fetch>
__device__ __forceinline__ u32 score(const Block& b, Fetch fetch, int half, int first, float scale) {
  constexpr int CHAINS = HALF <= 2 ? 2 : 1, STEPS = SPLIT_KEYS ? QT / 2 : QT,
                UNROLL = SPLIT_KEYS ? 4 : HALF <= 2 ? 8 : 2;
  const int k0 = SPLIT_KEYS ? half * STEPS : 0, n0 = SPLIT_KEYS ? 0 : half * HALF;
  float c[CHAINS][HALF][4];
#pragma unroll
  for (int i = 0; i < CHAINS; ++i) clear(c[i]);
  u32 seen = 0;
  const byte* q = b.smem + M_H + H_Q + (k0 * NT + n0) * 256 + b.lane * 8;
#pragma unroll(UNROLL)
  for (int k = 0; k < STEPS; ++k) {
    const uint4 a = fetch(k0 + k);
    seen ^= a.x;
#pragma unroll
    for (int n = 0; n < HALF; ++n)
      if (n0 + n < NT) mma(c[k % CHAINS][n], a, *(const uint2*)(q + (k * NT + n) * 256));
  }
  float* logits = (float*)(b.smem + M_X + X_LOGITS) + (SPLIT_KEYS ? half * T * LS : 0) + first + b.g();
#pragma unroll
  for (int n = 0; n < HALF; ++n)
#pragma unroll
    for (int i = 0; i < 4; ++i) {
      const int token = (n0 + n) * 8 + 2 * b.t() + (i & 1);
      float v = c[0][n][i];
      if (CHAINS == 2) v += c[CHAINS - 1][n][i];
      if (token < T) logits[token * LS + (i >> 1) * 8] = v * scale;
    }
  return seen;
}

// Suffix keys (kind 0) or values (1) of this rank, from all clusters, to shared memory; by four warps.
__device__ __forceinline__ void fetch_suffix(const Block& b, const float* kv, u32 bit, int kind, int me, int first,
                                             int count) {
  byte* to = b.smem + M_X + X_SUFFIX + kind * SUFFIX * RS;
#pragma unroll 1
  for (int i = me; i < count * (HD / 4); i += 128) {
    const int row = i / (HD / 4), quad = i % (HD / 4);
    uint4 v[1];
    poll(v, (const uint4*)(kv + size_t(first + row) * 2 * HD + kind * HD) + quad, 0, bit);
    *(uint2*)(to + row * RS + quad * 8) = make_uint2(pack(__uint_as_float(v[0].x), __uint_as_float(v[0].y)),
                                                     pack(__uint_as_float(v[0].z), __uint_as_float(v[0].w)));
  }
}

// Softmax over this rank's keys: unnormalised probabilities (operand B of the next product), and to all ranks each
// token's maximum and sum.
__device__ __forceinline__ void softmax(const Block& b, int prefix, int suffix) {
  constexpr int COLS = (KT + 1) * 16, PER = most(COLS, 32);
#pragma unroll 1
  for (int token = b.warp; token < T; token += W) {
    const float* row = (const float*)(b.smem + M_X + X_LOGITS) + token * LS;
    float v[PER], top = __int_as_float(0xff800000), sum = 0;
#pragma unroll
    for (int i = 0; i < PER; ++i) {
      const int col = i * 32 + b.lane;
      v[i] = __int_as_float(0xff800000);
      if (col < prefix || (col >= KT * 16 && col < KT * 16 + suffix))
        v[i] = SPLIT_KEYS ? row[col] + row[T * LS + col] : row[col];
      top = fmaxf(top, v[i]);
    }
#pragma unroll
    for (int o = 16; o; o >>= 1) top = fmaxf(top, exchange(top, o));
#pragma unroll
    for (int i = 0; i < PER; ++i) {
      const int col = i * 32 + b.lane, in = col & 15;
      const u32 p = pack(v[i] == __int_as_float(0xff800000) ? 0.0f : exp2_approx(v[i] - top), 0);
      sum += __uint_as_float(p << 16);
      if (col < COLS)
        *(unsigned short*)(b.smem + M_X + X_P + ((col >> 4) * NT + (token >> 3)) * 256 +
                           ((token & 7) * 4 + ((in & 7) >> 1)) * 8 + (in >> 3) * 4 + (in & 1) * 2) = (unsigned short)p;
    }
#pragma unroll
    for (int o = 16; o; o >>= 1) sum += exchange(sum, o);
    if (b.lane < S)
      send(at_rank(b.base + M_X + X_ML + (b.rank * T + token) * 8, b.lane), __float_as_uint(top), __float_as_uint(sum),
           at_rank(b.bar(BAR_COMB), b.lane));
  }
}

// Probabilities times 16 keys' values, for one tile of columns.
__device__ __forceinline__ void weigh(const Block& b, float (&c)[NT][4], uint4 values, int block) {
  const byte* p = b.smem + M_X + X_P + block * NT * 256 + b.lane * 8;
#pragma unroll
  for (int n = 0; n < NT; ++n) mma(c[n], values, *(const uint2*)(p + n * 256));
}

// Attention of this cluster's head, to region H of all ranks. Everything local lies in region X.
__device__ __forceinline__ void attend(Block& b, const float* kv, u32 bit, int prefix_all) {
  const int all = most(prefix_all, 16), tile0 = share(all, S, b.rank), tiles = share(all, S, b.rank + 1) - tile0;
  const int prefix = min(tiles * 16, prefix_all - tile0 * 16), slots = most(tiles, SLOT_TILES);
  const int suffix0 = share(T, S, b.rank), suffix = share(T, S, b.rank + 1) - suffix0;
  const float scale = rsqrtf(float(HD)) * 1.4426950408889634f;
  const int group = b.warp >> 2, half = b.warp & 1;
  receive(b, BAR_Q, b.n, Q_EXPECT, WAIT_Q);
  MARK(3)
#pragma unroll 1
  for (int i = 0; i < slots; ++i) {
    const u32 slot = take_slot(b);
    // this warp's tile of eight, if it is in the slot (a slot has two or four)
    const int sub = (b.warp >> 1) - i * SLOT_TILES % 8, tile = i * SLOT_TILES + sub;
    u32 seen = 0;
    if (sub >= 0 && sub < SLOT_TILES && tile < tiles && (SPLIT_KEYS || half * HALF < NT)) {
      const byte* from = b.ring(slot) + sub * KEY_TILE;
      seen = score(b, [&](int k) { return load_fragment(from + k * FRAGMENT, b.lane); }, half, tile * 16, scale);
    }
    give_slot(b, slot, seen);
  }
  MARK(4)
  if (suffix > 0) {
    if (group == 3) {
      fetch_suffix(b, kv, bit, 0, threadIdx.x & 127, suffix0, suffix);
      __syncwarp();
      asm volatile("bar.sync 2, 128;" ::: "memory");
      if (b.warp < 14 && (SPLIT_KEYS || half * HALF < NT)) {
        const int row = min((b.lane & 7) + (b.lane & 8), suffix - 1);  // rows beyond the last key hold anything
        const u32 from = b.base + M_X + X_SUFFIX + row * RS + (b.lane >> 4) * 16;
        auto fetch = [&](int k) {
          uint4 v;
          ldmatrix(v, from + k * 32);
          return v;
        };
        score(b, fetch, half, KT * 16, scale);
      }
    } else if (group == 2) {
      fetch_suffix(b, kv, bit, 1, threadIdx.x & 127, suffix0, suffix);
    }
  }
  consumers_sync();
  MARK(5)
  softmax(b, prefix, suffix);
  consumers_sync();
  MARK(6)
  float c[NT][4];
  clear(c);
  const bool mine = b.warp < QT;
#pragma unroll 1
  for (int i = 0; i < slots; ++i) {
    const u32 slot = take_slot(b);
    const byte* from = b.ring(slot) + b.warp * FRAGMENT;
    u32 seen = 0;
    if (mine) {
#pragma unroll
      for (int sub = 0; sub < SLOT_TILES; ++sub)
        if (i * SLOT_TILES + sub < tiles) {
          const uint4 v = load_fragment(from + sub * KEY_TILE, b.lane);
          seen ^= fold(v);
          weigh(b, c, v, i * SLOT_TILES + sub);
        }
    }
    give_slot(b, slot, seen);
  }
  if (mine) {
    if (suffix > 0) {
      const int row = min((b.lane & 7) + ((b.lane >> 4) << 3), suffix - 1);  // the others' probabilities are 0
      uint4 v;
      ldmatrix_transposed(v, b.base + M_X + X_SUFFIX + (SUFFIX + row) * RS + (b.warp * 16 + (b.lane & 8)) * 2);
      weigh(b, c, v, KT);
    }
    const int owner = ((b.warp + 1) * S - 1) / QT, tile = b.warp - share(QT, S, owner);
#pragma unroll
    for (int n = 0; n < NT; ++n)
      if (n * 8 + 2 * b.t() < T)
        send(at_rank(b.base + M_X + X_COMB + ((b.rank * QTL + tile) * NT + n) * 512 + b.lane * 16, owner),
             make_float4(c[n][0], c[n][1], c[n][2], c[n][3]), at_rank(b.bar(BAR_COMB), owner));
  }
  MARK(7)
  const int qn = b.qn();
  receive(b, BAR_COMB, b.n, S * T * 8 + S * qn * ((T + 1) / 2) * 128, WAIT_COMB);
  MARK(8)
#pragma unroll
  for (int j = 0; j < most(QTL * NT, W); ++j) {
    const int i = b.warp + j * W;
    if (i < qn * NT) {
      const int tile = i % qn, n = i / qn, token = n * 8 + 2 * b.t();
      float2 ml[S][2];
      float top0 = __int_as_float(0xff800000), top1 = top0, sum0 = 0, sum1 = 0;
#pragma unroll
      for (int s = 0; s < S; ++s) {
        const float2* p = (const float2*)(b.smem + M_X + X_ML) + s * T;
        ml[s][0] = p[min(token, T - 1)], ml[s][1] = p[min(token + 1, T - 1)];
        top0 = fmaxf(top0, ml[s][0].x), top1 = fmaxf(top1, ml[s][1].x);
      }
      float4 o = make_float4(0, 0, 0, 0);
#pragma unroll
      for (int s = 0; s < S; ++s) {
        const float4 v = *(const float4*)(b.smem + M_X + X_COMB + ((s * QTL + tile) * NT + n) * 512 + b.lane * 16);
        const float w0 = exp2_approx(ml[s][0].x - top0), w1 = exp2_approx(ml[s][1].x - top1);
        sum0 += w0 * ml[s][0].y, sum1 += w1 * ml[s][1].y;
        o.x += w0 * v.x, o.y += w1 * v.y, o.z += w0 * v.z, o.w += w1 * v.w;
      }
      const float i0 = __fdividef(1.0f, sum0), i1 = __fdividef(1.0f, sum1);
      send_columns(b, M_H + H_ATT, b.q0() + tile, n, make_float4(o.x * i0, o.y * i1, o.z * i0, o.w * i1), BAR_ATT,
                   true);
    }
  }
  MARK(9)
  receive(b, BAR_ATT, b.n, HD * T * 2, WAIT_ATT);
  MARK(10)
}
